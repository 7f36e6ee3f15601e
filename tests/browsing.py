"""Pages of the console in a browser: what they complain of, and whom they ask."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

PATIENCE_MS = 60_000


class Pages:
    """Pages of one console, what they complained of, and whom they asked."""

    def __init__(self, browser: Any, url: str) -> None:
        self.url = url
        self.complaints: list[str] = []
        self.hosts: set[str] = set()
        self._context = browser.new_context(viewport={"width": 1280, "height": 800})
        self._context.set_default_timeout(PATIENCE_MS)

    def open_as(self, token: str, prepare: Callable[[Any], object] = lambda _page: None) -> Any:
        """A page that is logged in by this token; `prepare(page)` is called before it is loaded."""
        response = self._context.request.post(f"{self.url}/login", data={"token": token})
        assert response.ok, response.text()
        return self.open(prepare=prepare)

    def open(self, view: str = "now", prepare: Callable[[Any], object] = lambda _page: None) -> Any:
        page = self._context.new_page()
        prepare(page)
        page.on("console", self._hear)
        page.on("pageerror", lambda error: self.complaints.append(str(error)))
        page.on("request", lambda request: self.hosts.add(re.split("[/?#]", request.url)[2]))
        page.goto(f"{self.url}/#{view}")
        page.wait_for_selector("#view > *")
        return page

    def _hear(self, message: Any) -> None:
        if message.type == "error":
            self.complaints.append(f"{message.text} {message.location['url']}")

    def close(self) -> None:
        self._context.close()


def says(page: Any, text: str) -> None:
    """Wait until the view's headline says so."""
    page.wait_for_selector(f"h1:has-text({text!r})")

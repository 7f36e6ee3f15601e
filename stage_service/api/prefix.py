"""The service under a path prefix of a proxy."""

from __future__ import annotations

import re

from starlette.datastructures import MutableHeaders
from starlette.responses import RedirectResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from stage_service.api.gate import Access
from stage_service.api.scopes import ROUTES


def checked(prefix: str) -> str:
    """The prefix without a slash at its end. Raises `ValueError` if it cannot be one."""
    prefix = prefix.rstrip("/")
    if prefix and not re.fullmatch(r"(/[\w-]+)+", prefix, re.ASCII):
        raise ValueError(
            f"--root-path {prefix}: expected names of letters, digits, _ and -, each after a slash"
        )
    if prefix and prefix.split("/")[1] in {route.path.split("/")[1] for _, route in ROUTES}:
        raise ValueError(f"--root-path {prefix}: the service has such a path: choose another")
    return prefix


class Prefixed:
    """Removes the prefix of `access` from requests' paths, and adds it to `Location`."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app, self._access = app, access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or redirect the prefix alone to the page."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        prefix, path = self._access.prefix, scope["path"]

        async def prefixed(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                if headers.get("location", "").startswith("/"):
                    headers["location"] = prefix + headers["location"]
            await send(message)

        if path == prefix:  # the page's addresses are relative to its folder
            await RedirectResponse("/", 308)(scope, receive, prefixed)
            return
        await self._app({**scope, "path": self._access.inner(path)}, receive, prefixed)

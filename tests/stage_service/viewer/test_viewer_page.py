"""The viewer in a browser: it draws, turns, complains of nothing and asks nobody else."""

from __future__ import annotations

import base64
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
import pytest

api = pytest.importorskip("playwright.sync_api", reason="Playwright is not installed")
CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
pytestmark = [
    pytest.mark.slow,  # a browser without a GPU takes minutes of a busy machine
    pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium here"),
]
PATIENCE_MS = 300_000


@dataclass
class Seen:
    """A page, what it complained of, and the hosts that it asked."""

    page: Any
    complaints: list[str] = field(default_factory=list)
    hosts: set[str] = field(default_factory=set)

    def picture(self) -> np.ndarray:
        """What is on the canvas `(H, W, 4)`, 0 to 255."""
        url = self.page.evaluate("document.getElementById('canvas').toDataURL()")
        data = np.frombuffer(base64.b64decode(url.partition(",")[2]), np.uint8)
        return cv2.imdecode(data, cv2.IMREAD_UNCHANGED)

    def drawn(self, what: str = "true") -> None:
        """Wait until everything is there and drawn, and `what` holds."""
        self.page.wait_for_function(
            "window.viewer?.complete && !viewer.moved && viewer.picture.ready() && "
            f"viewer.picture.frames > 0 && {what}",
            timeout=PATIENCE_MS,
        )


@pytest.fixture
def seen(url: str) -> Iterator[Seen]:
    arguments = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with api.sync_playwright() as p:
        browser = p.chromium.launch(executable_path=CHROMIUM, args=arguments, timeout=PATIENCE_MS)
        page = browser.new_page(viewport={"width": 900, "height": 500}, bypass_csp=True)
        seen = Seen(page)
        page.on("console", lambda m: seen.complaints.append(m.text) if m.type == "error" else None)
        page.on("pageerror", lambda e: seen.complaints.append(str(e)))
        page.on("request", lambda r: seen.hosts.add(r.url.partition("://")[2].partition("/")[0]))
        page.goto(f"{url}/view#model=bristles&token=the%20key", timeout=PATIENCE_MS)
        yield seen
        browser.close()


def test_strands_are_drawn_turn_and_take_another_colour(seen, url):
    seen.drawn()
    assert "400 strands" in seen.page.inner_text("#panel")
    before = seen.picture()
    # a half ball of 13 cm, whole in the picture
    assert 0.05 < (before[..., 3] > 0).mean() < 0.75
    seen.page.focus("#canvas")
    seen.page.keyboard.press("ArrowLeft")
    seen.page.wait_for_function("viewer.orbit.azimuth > -50", timeout=PATIENCE_MS)
    seen.drawn()
    assert np.abs(seen.picture().astype(int) - before).mean() > 1

    seen.page.select_option("select >> nth=0", "length")
    seen.page.select_option("select >> nth=1", "truth")
    seen.drawn("viewer.picture.state.mode === 'length'")
    hair = seen.picture()
    yellow = (hair[..., 2] > 1.5 * hair[..., 0]) & (hair[..., 1] > 1.5 * hair[..., 0])
    assert yellow.sum() > 500  # all are as long as the longest
    assert seen.complaints == []
    assert seen.hosts == {url.partition("://")[2]}
    assert "token" not in seen.page.evaluate("location.href")

"""A Chromium for benchmarks."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from typing import Any

from benchmarks.command import LeftOut


@contextlib.contextmanager
def chromium() -> Iterator[Any]:
    """`launch(*arguments)` starts a browser, which ends with the block. Raises `LeftOut`."""
    path = shutil.which("chromium") or shutil.which("google-chrome")
    try:
        from playwright.sync_api import sync_playwright
    except ImportError as error:
        raise LeftOut("Playwright is not installed: pip install 'hairstage[test]'") from error
    if path is None:
        raise LeftOut("there is no Chromium here")
    with sync_playwright() as playwright:
        yield lambda *arguments: playwright.chromium.launch(
            executable_path=path, args=["--no-sandbox", *arguments]
        )

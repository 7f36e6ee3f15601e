"""A Chromium, and the console of a simulated stage in it."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from browsing import Pages
from filming import Film
from serving import Client, serving

from simulators.peers.faults import Fault


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    api = pytest.importorskip("playwright.sync_api", reason="Playwright is not installed")
    path = shutil.which("chromium") or shutil.which("google-chrome")
    if path is None:
        pytest.skip("there is no Chromium here")
    with api.sync_playwright() as p:
        browser = p.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture
def film(tmp_path: Path) -> Film:
    """HAIRSTAGE_FILM=folder keeps its pictures."""
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="no axe here")
    folder = Path(os.environ.get("HAIRSTAGE_FILM", tmp_path / "film"))
    folder.mkdir(parents=True, exist_ok=True)
    return Film(folder, axe.Axe())


@pytest.fixture
def console(simulated, tmp_path, browser) -> Iterator[Callable[..., tuple[Client, Pages]]]:
    """`console(*faults)`: a service and its pages, which must not complain nor ask others.

    `rig=text` for another rig file than the small one.
    """
    with ExitStack() as stack:
        opened: list[Pages] = []

        def start(*faults: Fault, **rig: str) -> tuple[Client, Pages]:
            rig_file, _ = simulated(*faults, **rig)
            http = stack.enter_context(serving(rig_file, tmp_path / "root"))
            pages = Pages(browser, str(http.base_url).rstrip("/"))
            stack.callback(pages.close)
            opened.append(pages)
            return http, pages

        yield start
        for pages in opened:
            assert pages.complaints == []
            assert pages.hosts == {pages.url.partition("//")[2]}

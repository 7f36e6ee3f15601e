"""Logging in from a browser: the one test of pages that is not slow."""

from urllib.parse import urlsplit

import pytest
from browsing import Pages, says
from serving import serving

from stage_service.api.gate import Access
from stage_service.records.attempts import FREE
from stage_service.records.tokens import Tokens


@pytest.mark.parametrize("prefix", [pytest.param("", marks=pytest.mark.slow), "/stage"])
def test_a_page_without_a_login_shows_the_login_form(simulated, browser, tmp_path, prefix):
    """Under a path prefix every request of the page has it."""
    access, paths = Access(Tokens(tmp_path / "none", "the key"), prefix=prefix), []
    with serving(simulated()[0], tmp_path / "root", access, all_read=False) as http:
        pages = Pages(browser, str(http.base_url).rstrip("/") + prefix)
        page = pages.open(
            prepare=lambda page: page.on("request", lambda r: paths.append(urlsplit(r.url).path))
        )
        page.wait_for_selector("[name=token]:focus")
        page.keyboard.type("another")
        page.keyboard.press("Enter")
        page.wait_for_selector("form .bad:not(:empty)")
        page.fill("[name=token]", "the key")
        page.keyboard.press("Enter")
        says(page, "Dark, verified")
        stored = page.evaluate("JSON.stringify({...localStorage, ...sessionStorage})")
        assert "the key" not in stored
        page.context.clear_cookies()
        page.reload()
        page.wait_for_selector("[name=token]:focus")
        for _ in range(FREE):  # another program at this address makes it wait, and not this page
            http.post("/login", json={"token": "guessed"})
        assert http.post("/login", json={"token": "the key"}).status_code == 429
        page.fill("[name=token]", "the key")
        page.keyboard.press("Enter")
        says(page, "Dark, verified")
        page.keyboard.press("F9")
        page.wait_for_selector("text=dark, verified, after")
        pages.close()
    assert f"{prefix}/devices/blackout" in paths
    assert all(path.startswith(f"{prefix}/") for path in paths), paths

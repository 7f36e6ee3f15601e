"""Logging in from a browser: the one test of pages that is not slow."""

from browsing import Pages, says
from serving import serving

from stage_service.api.gate import Access
from stage_service.records.attempts import FREE
from stage_service.records.tokens import Tokens


def test_a_page_without_a_login_shows_the_login_form(simulated, browser, tmp_path):
    access = Access(Tokens(tmp_path / "none", "the key"))
    with serving(simulated()[0], tmp_path / "root", access, all_read=False) as http:
        pages = Pages(browser, str(http.base_url).rstrip("/"))
        page = pages.open()
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
        pages.close()

"""What the console's sentences claim: no more than is known, and in an operator's words."""

from __future__ import annotations

import re
from threading import Event
from typing import Any

import pytest
from browsing import says
from waiting import until

from simulators.peers.faults import Fault
from stage_service.frames import Frames
from stage_service.web.pages import STATIC

pytestmark = pytest.mark.slow  # a browser costs some seconds of processor time a page
PACED = {"rate_hz": 8, "projectors": [], "stepping": "software"}
SHORT = {"lights": ["light_003"], "projectors": [], "sentinels": False}


def test_a_bank_whose_read_back_contradicted_a_command_verifies_nothing(console):
    http, pages = console(Fault("lights", "lies", 3))
    page = pages.open()
    capture = http.post("/captures", json={"plan": PACED}).json()["id"]
    says(page, "Reported dark")
    page.wait_for_selector(f".alarm:has-text('In capture {capture} it reported lamps as off')")
    page.wait_for_selector("#top .state:text-is('reported dark')")
    page.keyboard.press("F9")
    page.wait_for_selector(".notice:has-text('Reported dark, after')")
    page.reload()
    says(page, "Reported dark")
    assert "verified" not in page.text_content("body")
    # A capture that ends before a lamp is lit confirms nothing of the bank.
    dark = {"lights": [], "projectors": []}
    second = http.post("/captures", json={"plan": {**dark, "sentinels": False}})
    if second.status_code == 202:
        until(lambda: http.get(f"/captures/{second.json()['id']}").json()["outcome"])
    says(page, "Reported dark")


def test_a_dialog_keeps_blackout_by_mouse_and_by_key(console):
    http, pages = console()
    http.post("/queue:hold").raise_for_status()
    http.post("/queue", json={"plan": PACED}).raise_for_status()
    page = pages.open()
    for press in (lambda: page.click("button.blackout"), lambda: page.keyboard.press("F9")):
        http.post("/captures", json={"plan": PACED}).raise_for_status()
        says(page, "Shooting")
        page.click("text=Release the queue")
        page.wait_for_selector("dialog:has-text('The queue is held')")
        press()
        says(page, "Dark, verified")
        page.click("dialog button:text-is('Cancel')")
        assert len(http.get("/queue").json()["waiting"]) == 1
    page.click("text=Release the queue")
    page.click("dialog button:text-is('Begin')")
    says(page, "Shooting")
    page.keyboard.press("F9")
    says(page, "Dark, verified")


def test_an_emergency_stop_is_named_apart_from_watchdog_and_interlock(console):
    http, pages = console(Fault("trigger", "estop", 3))
    page = pages.open()
    http.post("/captures", json={"plan": PACED}).raise_for_status()
    alarm = page.wait_for_selector(".alarm:has-text('failed')").text_content()
    assert "emergency stop" in alarm
    assert "watchdog" not in alarm
    assert "interlock" not in alarm.replace("interlock closed", "")
    page.keyboard.press("F9")
    page.wait_for_selector("dd:has-text('reported then: the emergency stop is pressed')")


def test_blackout_overtakes_the_pictures_that_a_slow_service_sends(console, small_rig, monkeypatch):
    """A browser has six connections to a host; here pictures hold five, and the events one."""
    go_on, waiting, make = Event(), [], Frames.preview

    def slow(*args: Any, **more: Any) -> bytes:
        waiting.append(1)
        assert go_on.wait(60)
        return make(*args, **more)

    monkeypatch.setattr(Frames, "preview", slow)
    camera = small_rig[
        small_rig.index("[[cameras]]") : small_rig.index('[[cameras]]\nname = "cam_b')
    ]
    more = "".join(camera.replace("cam_a", f"cam_{x}") for x in "cdefgh")
    http, pages = console(rig=small_rig.replace("[[projectors]]", f"{more}[[projectors]]", 1))
    done = http.post("/captures", json={"plan": SHORT}).json()["id"]
    until(lambda: http.get(f"/captures/{done}").json()["outcome"] == "completed")
    page = pages.open(f"frames/{done}")
    until(lambda: len(waiting) >= 5)
    http.post("/captures", json={"plan": PACED}).raise_for_status()
    page.keyboard.press("F9")
    page.wait_for_selector(".notice:has-text('Dark, verified')")
    assert not go_on.is_set()
    go_on.set()
    loaded = "[...document.querySelectorAll('figure img')].filter(x => x.naturalWidth).length"
    until(lambda: page.evaluate(loaded) == 8)  # they are loaded after it


def test_pages_run_under_a_policy_without_inline_code(console):
    http, pages = console()
    for path in ("/", "/docs"):
        headers = http.get(path).headers
        policy = headers["content-security-policy"]
        assert "script-src 'self'" in policy
        assert "frame-ancestors 'none'" in policy
        assert "unsafe" not in policy
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["referrer-policy"] == "no-referrer"
        assert headers["cache-control"] == "no-cache"
    for page in STATIC.glob("*.html"):
        text = page.read_text()
        assert re.findall(r"<style|style=|\son\w+=|<script(?![^>]*src=)", text) == []
    page = pages.open()
    for view in ("plan", "cameras", "frames", "stage", "jobs", "calibrate"):
        page.evaluate(f"location.hash = '#{view}'")
        page.wait_for_selector("#view > *")
    page.goto(f"{pages.url}/docs")
    page.wait_for_selector("details")  # `console` fails where the policy was violated

"""The console in a browser, over a simulated stage on real wires."""

from __future__ import annotations

from threading import Event
from typing import Any

import cv2
import numpy as np
import pytest
from browsing import Pages, says
from serving import serving
from waiting import until

from reconstruction import Model
from simulators.frames.frames import FrameMaker
from simulators.peers.faults import Fault
from stage_service.acquisition.safety import Blackout

pytestmark = pytest.mark.slow  # a browser costs some seconds of processor time a page
RING = (0x62, 0xA8, 0xB6)
PACED = {"rate_hz": 8, "projectors": [], "stepping": "software"}


def ring(page: Any) -> int:
    """How many pixels within 5 of what has the focus are of the ring's colour."""
    r = page.evaluate("document.activeElement.getBoundingClientRect().toJSON()")
    clip = {"x": r["x"] - 5, "y": r["y"] - 5, "width": r["width"] + 10, "height": r["height"] + 10}
    picture = cv2.imdecode(np.frombuffer(page.screenshot(clip=clip), np.uint8), cv2.IMREAD_COLOR)
    return int((np.abs(picture[..., ::-1].astype(int) - RING).max(-1) < 12).sum())


def tab_to(page: Any, condition: str) -> None:
    """Press Tab until the element that has the focus, `x`, is the one; a ring shows it."""
    for _ in range(150):
        page.keyboard.press("Tab")
        if page.evaluate(f"(x => {condition})(document.activeElement)"):
            assert ring(page) > 100
            return
    raise AssertionError(f"Tab leads to nothing of which {condition}")


def test_a_capture_by_the_keyboard_alone(console):
    http, pages = console()
    page = pages.open()
    says(page, "Dark, verified")
    tab_to(page, "x.textContent === 'Plan'")
    page.keyboard.press("Enter")
    page.wait_for_selector(".cost .facts")
    for field, keys in (("projectors", "none"), ("stepping", "s"), ("rate_hz", "2")):
        tab_to(page, f"x.name === {field!r}")
        page.keyboard.type(keys)
    page.wait_for_selector(".cost:has-text('2 Hz')")
    tab_to(page, "x.textContent === 'Start now'")
    page.keyboard.press("Enter")
    page.wait_for_selector("dialog input:focus")
    page.keyboard.type("  ")  # nobody's name: it is asked for again
    page.keyboard.press("Enter")
    page.keyboard.type("Ada ")
    page.keyboard.press("Enter")
    says(page, "Shooting")
    tab_to(page, "x.textContent === 'Pause'")
    page.keyboard.press("Enter")
    says(page, "Paused")
    tab_to(page, "x.textContent === 'Resume'")
    page.keyboard.press("Space")
    says(page, "Shooting")
    page.keyboard.press("F7")
    page.wait_for_selector(".black:focus")
    page.keyboard.press("Escape")
    tab_to(page, "x.textContent.startsWith('Abort')")
    page.keyboard.press("Enter")
    says(page, "Dark, verified")
    assert http.service.captures(1)[0].outcome == "aborted"


def test_a_lease_taken_while_the_page_loads_is_shown(console):
    http, pages = console()
    held: list[tuple[Any, Any]] = []

    def hold_first(route: Any) -> None:
        if held:
            route.continue_()
        else:
            held.append((route, route.fetch()))

    page = pages.open(prepare=lambda page: page.route("**/lease", hold_first))
    until(lambda: page.wait_for_timeout(20) or held)
    assert http.post("/lease", json={"holder": "Eve", "seconds": 600}).status_code == 201
    page.wait_for_selector("text=Eve steers")  # by the event
    with page.expect_response("**/lease"):
        held[0][0].fulfill(response=held[0][1])  # from before the lease
    says(page, "Dark, verified")
    page.wait_for_timeout(300)
    page.wait_for_selector("text=Eve steers", timeout=10_000)


def test_patterns_of_lights_are_planned_and_shot(console):
    """31 patterns of 24 lights, and the frames before and after them, of two cameras."""
    http, pages = console()
    page = pages.open("plan")
    page.click("text=patterns of lights")
    assert page.input_value("[name=patterns]") == "s_matrix"
    page.wait_for_selector(f".cost dl:has-text('{2 * (31 + 4)}')")
    page.select_option("[name=patterns]", "")
    page.wait_for_selector(f".cost dl:has-text('{2 * (24 + 4)}')")
    page.select_option("[name=patterns]", "gradients")
    page.wait_for_selector(f".cost dl:has-text('{2 * (7 + 4)}')")
    page.click("button:text-is('Start now')")
    page.fill("[name=holder]", "Ada")
    page.click("dialog button")
    says(page, "Dark, verified")
    (capture,) = http.get("/captures").json()
    steps = http.get(f"/captures/{capture['id']}/steps").json()
    assert [s["pattern"] for s in steps if s["pattern"]][:2] == ["full", "x"]
    page.goto(page.url.partition("#")[0] + f"#frames/{capture['id']}")
    page.wait_for_selector("text=pattern full")


def test_invalid_numbers_in_fields_are_refused(console):
    http, pages = console()
    page = pages.open("plan")
    page.wait_for_selector("button:text-is('Start now'):enabled")
    page.type("[name='exposure.olat']", "1e")
    page.wait_for_selector(".cost .problems:has-text('exposure.olat')")
    assert page.is_disabled("button:text-is('Start now')")
    page.type("[name='exposure.olat']", "-2")
    page.wait_for_selector("button:text-is('Start now'):enabled")
    page.click("nav >> text=Cameras")
    page.type("[name=exposure]", "1e")
    page.click("text=Take a snapshot")
    page.wait_for_selector(".notice:has-text('exposure: ')")
    assert [a.result for a in http.service.audit(10) if a.action == "snapshot"] == []
    assert [c for c in pages.complaints if "422" not in c] == []
    pages.complaints.clear()


def test_calibration_captures_are_kept_while_another_view_is_open(console, monkeypatch):
    make, go_on = FrameMaker.counts, Event()

    def slow(self, camera, shot, exposure):
        assert go_on.wait(60)
        return make(self, camera, shot, exposure)

    monkeypatch.setattr(FrameMaker, "counts", slow)
    http, pages = console()
    page = pages.open("calibrate")
    page.click("button:text-is('Shoot: board')")
    page.fill("[name=holder]", "Ada")
    page.click("dialog button")
    says(page, "Calibrate")
    until(lambda: http.get("/captures").json())
    page.click("nav >> text=Now")
    says(page, "Shooting")
    go_on.set()
    says(page, "Dark, verified")
    (capture,) = http.get("/captures").json()
    page.click("nav >> text=Calibrate")
    page.wait_for_selector(f".poses button:text-is('{capture['id']}')")


UNREAD = """[devices.lights.registers]
lit = "none"
[devices.lights]
accept_unverified_blackout = true"""
"""A light bank that cannot say whether its lamps are off."""


def test_nothing_is_called_dark_that_was_not_read_back(console, small_rig):
    http, pages = console(rig=small_rig.replace("[devices.lights]", UNREAD))
    page = pages.open()

    def alarms_with(headline: str, bar: str, lit: str) -> str:
        """What stands above the view, once the rest is as it should be."""
        says(page, headline)
        page.wait_for_selector(f"#top .state:text-is({bar!r})")
        page.wait_for_selector(f"p.lit:text-is({lit!r})")
        return str(page.text_content("#alarms"))

    says(page, "Off was sent, not read back")
    http.post("/captures", json={"plan": {**PACED, "lights": ["light_003"]}})
    until(lambda: http.service.captures(1)[0].state == "done")
    sent = "off was sent; the light bank cannot report what is lit"
    alarm = alarms_with("Off was sent, not read back", "off was sent", sent)
    assert "the light bank cannot report whether the lamps are off" in alarm
    assert "A blackout cannot verify it: inspect the stage before anybody enters." in alarm
    page.click("nav >> text=Stage")
    page.wait_for_selector(
        ".device:has-text('responds, but cannot report whether its lamps are off')"
    )
    assert "safe" not in page.text_content("#view .grid")
    page.click("nav >> text=Now")

    stage = http.service._captures.stage
    stage.learn(Blackout(False, "unknown, unsafe: lights: no answer."))
    alarm = alarms_with("UNSAFE", "unsafe", "not known what is lit")
    assert "This light bank cannot report whether its lamps are off" in alarm
    page.fill("[name=name]", "Ada")
    page.fill("[name=note]", "all dark")
    page.click("text=I looked")
    assert not alarms_with(
        "Reported dark by a person",
        "reported by a person",
        "no lamp is lit, as a person at the stage reports",
    )
    page.keyboard.press("F9")
    assert "A blackout cannot verify it" in alarms_with(
        "Off was sent, not read back", "off was sent", sent
    )


def test_a_blackout_refused_with_503_is_repeated(console):
    http, pages = console()
    page = pages.open()
    says(page, "Dark, verified")
    left = [503, 503]  # as where all connections are taken

    def respond(route: Any) -> None:
        if left:
            route.fulfill(status=left.pop(), body="")
        else:
            route.continue_()

    page.route("**/devices/blackout", respond)
    page.keyboard.press("F9")
    page.wait_for_selector(".notice:has-text('dark, verified')")
    assert [a.action for a in http.service.audit(10)] == ["blackout"]
    assert [c for c in pages.complaints if "503" not in c] == []
    pages.complaints.clear()


def test_cameras_show_a_snapshot_and_the_stage_what_each_missed(console):
    http, pages = console(Fault("camera", "drop", 1, "cam_b"))
    page = pages.open("cameras")
    page.select_option("[name=light]", "light_003")
    page.click("text=Take a snapshot")
    picture = page.wait_for_selector("figure img[src*='/snapshot/']")
    until(lambda: picture.evaluate("image => image.naturalWidth") == 16)
    page.wait_for_selector("figcaption:has-text('cam_b: no frame')")
    page.wait_for_selector(".quiet:has-text('light_003, ')")
    page.wait_for_selector("figcaption:has-text('focus')")
    assert http.get("/captures").json() == []
    page.click("nav >> text=Stage")
    card = page.wait_for_selector(".device:has(h3:text-is('camera cam_b'))").text_content()
    assert "missed1" in card
    assert "frames0" in card


def test_after_a_frame_that_is_missing_the_camera_shows_the_next_ones(console):
    http, pages = console(Fault("camera", "drop", 4, "cam_b"))
    lights = [f"light_{n:03d}" for n in range(3)]
    plan = {"projectors": [], "stepping": "software", "lights": lights, "retries": 0}
    http.post("/captures", json={"plan": plan}).raise_for_status()
    until(lambda: [c for c in http.service.captures(1) if c.state == "done"])
    page = pages.open()
    page.route("**/frames/2/cam_b.png*", lambda _route: None)  # on its way for ever
    page.click("nav >> text=Frames")
    page.wait_for_selector("img[src*='/frames/2/cam_b.png']")
    page.click("label:has-text('histogram, focus')")
    for step in (1, 2):
        page.locator("input[type=range]").evaluate(
            "(slider, step) => { slider.value = step; slider.dispatchEvent(new Event('input')); }",
            step,
        )
        if step == 1:
            page.wait_for_selector("figcaption:has-text('cam_b: no frame')")
            assert page.locator("figure:has-text('no frame') .histogram").count() == 0
    picture = page.wait_for_selector("img[src*='/frames/4/cam_b.png']")
    until(lambda: picture.evaluate("image => image.naturalWidth") == 16)


def test_queued_captures_are_reordered(console):
    http, pages = console()
    http.post("/queue:hold")
    names = [f"light_{n:03d}" for n in range(3)]
    for n in (1, 2, 3):
        http.post("/queue", json={"plan": {**PACED, "lights": names[:n]}})
    page = pages.open()

    def line(*lights: int) -> None:
        """Wait until captures of so many lights wait, on the page and in the service."""
        until(
            lambda: (
                [row[0] for row in page.locator(".queue li").all_text_contents()]
                == [str(n) for n in lights]
            ),
            20,
        )
        waiting = http.get("/queue").json()["waiting"]
        assert [len(x["request"]["plan"]["lights"]) for x in waiting] == list(lights)

    line(1, 2, 3)
    page.click(".queue li >> nth=2 >> button[aria-label='sooner']")
    line(1, 3, 2)
    assert page.locator(".queue li >> nth=0 >> button[aria-label='sooner']").is_disabled()
    page.click(".queue li >> nth=0 >> button[aria-label='later']")
    line(3, 1, 2)
    page.click(".queue li >> nth=1 >> button:text-is('remove')")
    line(3, 2)


def test_a_page_that_is_opened_in_a_pause_shows_the_capture_that_is_paused(console):
    http, pages = console()
    older = http.post("/captures", json={"plan": PACED}).json()["id"]
    http.post(f"/captures/{older}/abort").raise_for_status()
    until(lambda: http.service.capture(older).state == "done")
    newer = http.post("/captures", json={"plan": {"lights": [], "projectors": []}}).json()["id"]
    until(lambda: http.service.capture(newer).outcome == "completed")
    assert older < newer
    http.post(f"/captures/{older}/resume").raise_for_status()
    until(lambda: http.service.capture(older).state == "running")
    http.post(f"/captures/{older}/pause").raise_for_status()
    until(lambda: http.service.capture(older).state == "paused")
    page = pages.open()
    says(page, "Paused")
    assert older in page.text_content(".facts")
    page.keyboard.press("F8")
    says(page, "Dark, verified")
    until(lambda: http.service.capture(older).outcome == "aborted")


def test_a_bank_that_dies_in_a_pause_is_reported_and_resumes_after_repair(
    rig_file, world, tmp_path, browser
):
    with serving(rig_file, tmp_path / "root") as http:
        pages = Pages(browser, str(http.base_url).rstrip("/"))
        id_ = http.post("/captures", json={"plan": PACED}).json()["id"]
        page = pages.open()
        page.click("button:text-is('Pause')")
        says(page, "Paused")
        world.deaf_lights = True
        page.wait_for_selector(".status b.bad:has-text('Remove the cause first')")
        assert "light bank" in http.get(f"/captures/{id_}").json()["error"]
        world.deaf_lights = False
        page.wait_for_selector(".status b.bad", state="detached")
        page.click("button:text-is('Resume')")
        says(page, "Shooting")
        page.keyboard.press("F8")
        says(page, "Dark, verified")
        pages.close()
    assert pages.complaints == []


def test_a_capture_removed_elsewhere_disappears_from_the_page(console):
    http, pages = console()
    ids = []
    for _ in range(2):
        short = {"lights": [], "projectors": []}
        ids.append(http.post("/captures", json={"plan": short}).json()["id"])
        until(lambda: http.service.capture(ids[-1]).outcome == "completed")
    now, frames = pages.open(), pages.open("frames")
    now.wait_for_selector(f".status:has-text({ids[1]!r})")
    frames.wait_for_selector(f".list button:has-text({ids[1]!r})")
    loaded = "[...document.querySelectorAll('figure img')].filter(x => x.naturalWidth).length"
    until(lambda: frames.evaluate(loaded) == 2)  # no picture is asked for that is gone
    removed = http.delete(f"/captures/{ids[1]}").json()["name"]
    now.wait_for_selector(f".status:has-text({ids[0]!r})")
    frames.wait_for_selector(f".list button:has-text({ids[1]!r})", state="detached")
    frames.wait_for_selector(f"h2:has-text({ids[0]!r})")
    until(lambda: frames.evaluate(loaded) == 2)
    http.post(f"/trash/{removed}/restore").raise_for_status()
    now.wait_for_selector(f".status:has-text({ids[1]!r})")
    frames.wait_for_selector(f".list button:has-text({ids[1]!r})")


def test_an_open_job_shows_its_files_at_its_end_and_runs_again_with_its_options(console):
    http, pages = console()
    plan = {"lights": [], "projectors": []}
    capture = http.post("/captures", json={"plan": plan}).json()["id"]
    until(lambda: http.service.capture(capture).outcome == "completed")
    pipeline = {"name": "reconstruct", "priority": 8, "retries": 2, "timeout_s": 3600.5}
    job_request = {"capture": capture, "pipeline": pipeline, "model": "mine"}
    job = http.post("/jobs", json=job_request).json()["id"]
    page = pages.open(f"jobs/{job}")
    page.wait_for_selector(".status:has-text('Queued until a worker is free.')")
    Model(http.service.root / "models" / "mine").create().write_json("results.json", {"a": 1})
    http.delete(f"/jobs/{job}").raise_for_status()
    page.wait_for_selector("dd:text-is('cancelled')")
    page.wait_for_selector("summary:text-is('Files (1)')")
    assert page.is_visible("text=Download the model")
    assert not page.is_visible("text=View the strands")
    page.click("button:text-is('Run it again')")
    until(lambda: len(http.get("/jobs").json()) == 2)
    again = next(one for one in http.get("/jobs").json() if one["id"] != job)
    assert pipeline.items() <= {"name": again["pipeline"], **again}.items()

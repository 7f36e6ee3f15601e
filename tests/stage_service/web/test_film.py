"""A whole capture in screenshots, at three sizes, each of them looked over: what is cut off or
covered, what shines too bright beside a stage, and what axe says of it.

HAIRSTAGE_FILM=folder keeps the pictures. HAIRSTAGE_DEMO=folder, else runs/demo where `make demo`
has left it, brings hair before the cameras, and a job, its report and its strands to show.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import pytest
from browsing import says
from filming import Film
from waiting import until

from reconstruction import Capture, Model
from simulators.frames.frames import FrameMaker
from simulators.peers.faults import Fault
from stage_service.model_page import write_page

pytestmark = pytest.mark.slow
CHECKOUT = Path(__file__).resolve().parents[3]
PACED = {"rate_hz": 8, "projectors": [], "stepping": "software"}

AT_REST = """() => {
  const { relight, picture } = viewer;
  const still = relight.rest?.textures && !relight.applying;
  return still && picture.samples >= Math.max(8, picture.cycle());
}"""


@pytest.fixture(scope="module")
def demo() -> Path | None:
    """What `make demo` left, where there is such a folder."""
    folder = Path(os.environ.get("HAIRSTAGE_DEMO", CHECKOUT / "runs/demo"))
    return folder if (folder / "jobs.sqlite").is_file() else None


@pytest.fixture
def demo_root(demo: Path | None, tmp_path: Path) -> Iterator[None]:
    """It is what the service serves, for as long as the test takes: it is half a gigabyte."""
    root = tmp_path / "root"
    if demo:
        shutil.copytree(demo, root, symlinks=True)
        write_page(Model(root / "model"))
    yield
    shutil.rmtree(root, ignore_errors=True)


@pytest.fixture
def hold(monkeypatch, demo) -> Iterator[dict[int, Event]]:
    """`hold[pulse]`: while it is not set, the fourth camera's frame of that pulse is not there.

    Frames are those of the demo's capture, else grey.
    """
    held: dict[int, Event] = {}
    capture = Capture(demo / "capture") if demo else None

    def counts(self, camera, shot, exposure):
        if camera == "cam_03" and shot.pulse in held:
            assert held[shot.pulse].wait(120)
        c = self._rig.camera(camera)
        image = np.full((c.height, c.width, 3), 0.2 * shot.power.any())
        lit = np.flatnonzero(shot.power)
        if capture and lit.size:
            kind = "olat" if lit.size == 1 else "all_on"
            light = self._rig.lights[lit[0]].name if lit.size == 1 else None
            step = next(s for s in capture.steps if (s.kind, s.light) == (kind, light))
            image = capture.frame(step, camera)
        return np.clip(np.rint(64 + 50_000 * exposure * image), 0, 4095).astype(np.uint16)

    monkeypatch.setattr(FrameMaker, "counts", counts)
    yield held
    for event in held.values():
        event.set()


@pytest.fixture
def demo_rig(slack: int) -> str:
    """The demo's rig file; its devices answer as fast as the simulators do."""
    text = (CHECKOUT / "stage_service/rigs/demo.toml").read_text()
    return re.sub(r"watchdog_s = [\d.]+", f"watchdog_s = {2 * slack}", text)


@pytest.mark.usefixtures("demo_root")
def test_a_capture_as_a_film(hold, console, film, demo, demo_rig):
    hold[60] = Event()
    http, pages = console(Fault("camera", "drop", 20, "cam_05"), rig=demo_rig)
    page = pages.open()
    says(page, "Dark, verified")
    if demo:
        page.wait_for_selector(".light.shot")
    film.take(page, "idle")

    page.click("nav >> text=Plan")
    page.wait_for_selector(".cost .facts")
    film.take(page, "plan")
    page.mouse.wheel(0, 900)
    film.take(page, "plan_lower")
    page.evaluate("scrollTo(0, 0)")
    page.fill("[name=rate_hz]", "8")
    page.fill("[name=projectors]", "none")
    page.select_option("[name=stepping]", "software")
    page.wait_for_selector(".cost:has-text('8 Hz')")
    film.take(page, "plan_with_cost")
    page.fill("[name=lights]", "light_400")
    page.wait_for_selector("text=This plan cannot be captured")
    film.take(page, "plan_that_cannot_be")
    pages.complaints.clear()  # Chromium's own, of the refusal
    page.fill("[name=lights]", "")
    page.wait_for_selector(".cost .facts")
    page.click("text=Start now")
    page.wait_for_selector("dialog")
    film.take(page, "who_steers")
    page.fill("[name=holder]", "Ada")
    page.click("dialog button")
    says(page, "Shooting")
    page.wait_for_selector(".missing >> text=shot again")
    film.take(page, "shooting")
    page.wait_for_selector("text=3 of 8 cameras have responded")
    film.take(page, "a_slow_step")
    page.keyboard.press("F7")
    page.wait_for_selector(".black:focus")
    film.take(page, "black", brightest=1e-4)
    page.keyboard.press("Escape")
    page.keyboard.press("F8")
    says(page, "Aborting")
    film.take(page, "aborting")
    hold[60].set()
    says(page, "Dark, verified")
    film.take(page, "dark_verified")
    page.click("button:text-is('Shoot what is missing')")
    says(page, "Shooting")
    page.click("button:text-is('Pause')")
    says(page, "Paused")
    for _ in range(2):
        http.post("/queue", json={"plan": PACED}, headers=lease(page)).raise_for_status()
    page.wait_for_selector(".queue li >> nth=1")
    film.take(page, "paused_with_a_queue")
    page.keyboard.press("F9")
    says(page, "Dark, verified")
    film.take(page, "blackout")

    page.click("nav >> text=Cameras")
    page.click("text=Take a snapshot")
    page.wait_for_selector("figcaption:has-text('cam_07') >> text=focus")
    film.take(page, "cameras", brightest=1)
    page.click("nav >> text=Frames")
    until(lambda: page.evaluate("[...document.images].filter((x) => x.naturalWidth).length") == 8)
    film.take(page, "frames", brightest=1)
    page.mouse.wheel(0, 400)
    film.take(page, "frames_lower", brightest=1)
    page.click("nav >> text=Stage")
    page.wait_for_selector(".device >> nth=9")
    film.take(page, "stage")
    page.click("nav >> text=Jobs")
    page.wait_for_selector(".curve" if demo else "#view p.quiet:not(:empty)")
    film.take(page, "jobs")
    page.mouse.wheel(0, 700)
    film.take(page, "jobs_lower")
    page.click("nav >> text=Calibrate")
    page.wait_for_selector(".poses")
    film.take(page, "calibrate")
    page.goto(f"{pages.url}/docs")
    page.wait_for_selector("details")
    film.take(page, "docs")
    if demo:
        page.goto(f"{pages.url}/jobs/job-{(demo / 'capture').resolve().name}/artifacts/index.html")
        film.take(page, "report", brightest=1)
        page.goto(f"{pages.url}/view#model={(demo / 'model').resolve().name}")
        until(
            lambda: page.evaluate("Boolean(window.viewer?.complete && viewer.picture?.frames)"),
            pause=0.5,
        )
        film.take(page, "viewer", brightest=1)
        film_of_light(page, film)
    assert film.wrong == [], "\n".join(film.wrong)


def film_of_light(page: Any, film: Film) -> None:
    """The fitted model under light from either side and from all around, each at rest."""
    page.wait_for_selector("#dome")
    page.select_option("select >> nth=0", "lit")
    dome = page.locator("#dome").bounding_box()
    for name, across in (("left", 0.25), ("right", 0.75)):
        page.locator("#dome").click(
            position={"x": across * dome["width"], "y": 0.45 * dome["height"]}
        )
        film.take(page, f"viewer_lit_from_{name}", brightest=1, drawn=AT_REST)
    page.click("button:text-is('studio')")
    film.take(page, "viewer_lit_by_studio", brightest=1, drawn=AT_REST)


def lease(page: Any) -> dict[str, str]:
    """The header by which the page steers."""
    token = page.evaluate("JSON.parse(sessionStorage.getItem('lease')).token")
    return {"Hairstage-Lease": token}

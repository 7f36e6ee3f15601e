"""Killed without warning: the service in mid-capture."""

from __future__ import annotations

from pathlib import Path

import pytest
from waiting import until

from reconstruction import Capture


@pytest.mark.slow
def test_a_killed_service_leaves_no_lamp_lit_and_every_finished_frame(stage):
    pulse = 8
    stage.simulate([{"device": "trigger", "kind": "silent", "pulse": pulse}])
    service = stage.serve()
    capture = stage.post("/captures", {})
    stage.until(lambda: stage.get(f"/captures/{capture['id']}")["step"] == pulse - 1)
    # The service now waits for the trigger box's answer, and the lamp is on.
    stage.until(lambda: stage.lamps_lit() == 1)
    service.kill()
    service.wait()
    assert stage.lamps_lit() == 1
    until(lambda: stage.lamps_lit() == 0, stage.watchdog_s + 1.0 * stage.slack)

    path = Path(capture["path"])
    left = Capture(path)
    frames = [r for r in left.records.values() if r.file is not None]
    assert len(frames) >= stage.CAMERAS * (pulse - 2)
    for record in frames:
        assert left.frame(left.steps[record.step], record.camera).shape == (24, 24, 3)
    problems = stage.verify(path)
    missing = stage.FRAMES - len(frames)
    assert problems[:2] == [
        "manifest.json is missing: the capture was not finished.",
        f"{missing} planned frames were never captured; the first is step "
        f"{len(frames) // stage.CAMERAS} (olat), cam_{len(frames) % stage.CAMERAS}.",
    ]
    assert all("are not listed in the journal" in left_over for left_over in problems[2:])
    stage.serve()
    known = stage.get(f"/captures/{capture['id']}")
    assert (known["state"], known["outcome"]) == ("done", "interrupted")
    assert known["frames_written"] == len(frames)

"""Capture folders, read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from reconstruction.cameras import Camera
from reconstruction.capture import Capture, CaptureError, MissingFrame, Step
from reconstruction.capture_writer import CaptureWriter
from reconstruction.lights import Light
from reconstruction.rig import Rig

RIG = Rig(
    "one",
    (Camera.look_at("cam_0", 8, 6, [0, -1, 0], [0, 0, 0], 20),),
    tuple(Light(f"light_{i}", np.array([i, 1, 1]), np.ones(3)) for i in range(4)),
)
# Shot in another order than the rig's, and without light_1.
STEPS = (
    Step(0, "dark", 0.02, 0.0),
    *(Step(i + 1, "olat", 0.02, 0.5, light=f"light_{n}") for i, n in enumerate((3, 0, 2))),
    Step(4, "tracking", 0.02),
    Step(5, "scanline", 0.02, projector="proj", row=7),
)


@pytest.fixture
def capture(tmp_path: Path) -> Capture:
    """Every frame holds its step's index, but the scanline's never came."""
    writer = CaptureWriter.create(tmp_path / "c", RIG, {"steps": STEPS})
    for step in STEPS[:-1]:
        writer.write_frame(step, "cam_0", np.full((6, 8, 3), step.index, np.float32))
    writer.record_missing(STEPS[-1], "cam_0", reason="the camera was mute")
    writer.finish("completed", {})
    return Capture(tmp_path / "c")


def test_responses_come_in_rig_order_and_at_full_level(capture):
    assert capture.olat_lights() == ["light_0", "light_2", "light_3"]
    olat = capture.olat("cam_0")
    assert olat.shape == (3, 6, 8, 3)
    np.testing.assert_array_equal(olat[:, 0, 0, 0], [4, 6, 2])
    np.testing.assert_array_equal(capture.olat("cam_0", ["light_3"])[0], 2.0)


def test_steps_by_kind(capture):
    assert [s.light for s in capture.of_kind("olat")] == ["light_3", "light_0", "light_2"]
    assert capture.of_kind("scanline") == (STEPS[-1],)
    assert capture.of_kind("all_on") == ()


def test_missing_frames_say_why(capture):
    assert capture.has(STEPS[0], "cam_0")
    assert not capture.has(STEPS[-1], "cam_0")
    with pytest.raises(MissingFrame, match=r"step 5 \(scanline\), cam_0: the camera was mute"):
        capture.frame(STEPS[-1], "cam_0")
    with pytest.raises(MissingFrame, match=r"no frame for the lights \['light_1'\]"):
        capture.olat("cam_0", ["light_0", "light_1"])


def test_a_dark_frame_is_its_own_response(capture):
    np.testing.assert_array_equal(capture.response(STEPS[0], "cam_0"), 0.0)


def test_a_mask_of_the_wrong_size_is_named(capture):
    (capture.path / "masks").mkdir()
    (capture.path / "masks" / "cam_0.png").write_bytes(b"no picture")
    with pytest.raises(CaptureError, match=r"cam_0.png: expected a \(6, 8\) grey PNG"):
        capture.mask("cam_0")


@pytest.mark.parametrize(
    ("step", "problem"),
    [
        ({"index": 0, "kind": "flash", "exposure": 0.1}, "unknown kind 'flash'"),
        ({"index": 0, "kind": "dark"}, "exposure"),
        ({"index": 0, "kind": "dark", "exposure": 0.1, "lamp": "x"}, "unknown fields"),
    ],
)
def test_a_step_that_is_wrong_is_named(step, problem):
    with pytest.raises(CaptureError, match=problem):
        Step.from_dict(step)


def test_steps_read_back(capture):
    assert [Step.from_dict(s.to_dict()) for s in STEPS] == list(STEPS)
    assert capture.steps == STEPS


def test_a_broken_line_inside_the_journal_is_an_error(capture):
    journal = capture.path / "journal.jsonl"
    lines = journal.read_text().splitlines()
    journal.write_text("\n".join([lines[0], "{torn", *lines[2:]]) + "\n")
    with pytest.raises(CaptureError, match=r"journal.jsonl, line 2"):
        Capture(capture.path)

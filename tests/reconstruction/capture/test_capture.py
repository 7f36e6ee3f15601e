"""Capture folders, read."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from reconstruction import (
    Camera,
    Capture,
    CaptureError,
    CaptureWriter,
    Light,
    MissingFrame,
    Rig,
    Step,
)
from reconstruction.capture.stray_light import stray_light

RIG = Rig(
    "one",
    (Camera.look_at("cam_0", 8, 6, [0, -1, 0], [0, 0, 0], 20),),
    tuple(Light(f"light_{i}", np.array([i, 1, 1]), np.ones(3)) for i in range(4)),
)
SHARP = Camera.look_at("cam_0", 80, 60, [0, -1, 0], [0, 0, 0], 20)
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
    olat, known = capture.olat("cam_0")
    assert known.all()
    assert olat.shape == (3, 6, 8, 3)
    np.testing.assert_array_equal(olat[:, 0, 0, 0], [4, 6, 2])
    np.testing.assert_array_equal(capture.olat("cam_0", ["light_3"])[0][0], 2.0)


def test_steps_by_kind(capture):
    assert [s.light for s in capture.of_kind("olat")] == ["light_3", "light_0", "light_2"]
    assert capture.of_kind("scanline") == (STEPS[-1],)
    assert capture.of_kind("all_on") == ()


def test_missing_frames_say_why(capture):
    assert capture.has(STEPS[0], "cam_0")
    assert not capture.has(STEPS[-1], "cam_0")
    with pytest.raises(MissingFrame, match=r"step 5 \(scanline\), cam_0: the camera was mute"):
        capture.frame(STEPS[-1], "cam_0")
    with pytest.raises(MissingFrame, match=r"no single-light frames of \['light_1'\]"):
        capture.olat("cam_0", ["light_0", "light_1"])


def test_a_dark_frame_is_its_own_response(capture):
    np.testing.assert_array_equal(capture.response(STEPS[0], "cam_0"), 0.0)


def lit_beside(folder: Path, stray: float, noise: float) -> Capture:
    """A quarter of each frame has `stray` light; light_0 sends 0.3 at half level on top of it."""
    rng, rig = np.random.default_rng(0), replace(RIG, cameras=(SHARP,))
    there = np.zeros((60, 80, 3))
    there[:30, :40] = stray
    steps = (
        Step(0, "dark", 0.02, 0.0),
        Step(1, "dark", 0.5, 0.0),
        Step(2, "olat", 0.02, 0.5, light="light_0"),
    )
    writer = CaptureWriter.create(folder, rig, {"steps": steps})
    for step, light in zip(steps, (there, 9 * there, there + 0.15), strict=True):
        image = light + noise * rng.standard_normal(there.shape)
        writer.write_frame(step, "cam_0", image.astype(np.float32))
    writer.finish("completed", {})
    return Capture(folder)


@pytest.mark.parametrize(("stray", "noise"), [(0.05, 0.0), (0.05, 0.01), (5.0, 0.01)])
def test_light_in_dark_frames_of_the_same_exposure_is_taken_off(tmp_path, stray, noise):
    image, _ = lit_beside(tmp_path / "c", stray, noise).light("light_0", "cam_0")
    for part in (image[4:26, 4:36], image[34:, 44:]):
        assert part.mean() == pytest.approx(0.3, abs=0.2 * noise + 1e-6)


def test_dark_frames_are_read_once_a_camera_and_exposure(tmp_path, monkeypatch):
    capture, read = lit_beside(tmp_path / "c", 0.05, 0.0), []
    right = Capture.frame

    def frame(self, step, camera):
        read.append(step.index)
        return right(self, step, camera)

    monkeypatch.setattr(Capture, "frame", frame)
    for exposure in (0.02, 0.5, 0.02, 0.4):
        assert capture.stray_light_of("cam_0", exposure).max() == pytest.approx(
            0.05 if exposure < 0.1 else 0.45
        )
    assert read == [0, 1]


def test_noise_in_dark_frames_is_not(tmp_path):
    capture = lit_beside(tmp_path / "c", 0.0, 0.01)
    image, _ = capture.light("light_0", "cam_0")
    np.testing.assert_array_equal(image, capture.response(capture.steps[2], "cam_0"))


def test_a_dark_frame_that_is_no_picture_is_refused():
    with pytest.raises(ValueError, match="not numbers"):
        stray_light(np.full((8, 8, 3), np.nan, np.float32))
    assert stray_light(np.zeros((1, 1, 3), np.float32)) is None


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


def test_brackets_of_a_light_are_merged_without_what_is_saturated(tmp_path):
    exposures = (0.02, 0.002, 0.08)
    steps = [Step(i, "olat", t, 0.5, light="light_2") for i, t in enumerate(exposures)]
    writer = CaptureWriter.create(tmp_path / "c", RIG, {"steps": steps})
    # Left to right: in range of all, saturated in the longest, in all but the shortest, in all.
    true = np.array([1.0, 5.0, 20.0, 200.0])
    for step in steps:
        full = 2.0 * 0.08 / step.exposure
        observed = np.minimum(true + step.exposure, full)
        image = np.broadcast_to(np.repeat(observed, 2)[None, :, None], (6, 8, 3))
        writer.write_frame(step, "cam_0", image.astype(np.float32), full_scale=full)
    writer.close()
    response, saturated = Capture(tmp_path / "c").light("light_2", "cam_0")
    observed = [
        (1 + np.average(exposures, weights=exposures)),
        (5 + np.average(exposures[:2], weights=exposures[:2])),
        20.002,
        80.0,
    ]
    np.testing.assert_allclose(response[0, ::2, 0], 2 * np.array(observed), rtol=1e-5)
    np.testing.assert_array_equal(saturated[0, ::2], [False, False, False, True])


def test_a_lost_bracket_leaves_the_others(tmp_path):
    steps = [Step(i, "olat", t, light="light_2") for i, t in enumerate((0.01, 0.02))]
    writer = CaptureWriter.create(tmp_path / "c", RIG, {"steps": steps})
    writer.write_frame(steps[1], "cam_0", np.full((6, 8, 3), 3, np.float32))
    writer.record_missing(steps[0], "cam_0", reason="mute")
    writer.close()
    capture = Capture(tmp_path / "c")
    assert capture.has_light("light_2", "cam_0")
    np.testing.assert_array_equal(capture.light("light_2", "cam_0")[0], 3)
    assert not capture.has_light("light_0", "cam_0")

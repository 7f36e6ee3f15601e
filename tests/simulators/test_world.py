"""Poses of the subject, light vectors and what is kept of rendered responses."""

from __future__ import annotations

import numpy as np
import pytest

from simulators.frames.frames import FrameMaker, Sensor, Snapshot
from simulators.frames.responses import Response
from simulators.peers.faults import Faults
from simulators.peers.lamps import Lamps
from simulators.peers.projector_controller import Show
from simulators.subject.drift import Drift
from simulators.world import World

TRACKING, LINE = Show(32768), Show(65535, "proj", 2)


class Counting:
    """Responses that tell lamps, rows and poses apart; `calls` says what was rendered."""

    def __init__(self):
        self.calls = []

    def lights(self, camera):
        self.calls.append("lamps")
        return Response(np.arange(4), np.arange(1, 6, dtype=np.float32)[:, None, None] * ONES)

    def lights_together(self, camera, pose, power):
        self.calls.append(("together", pose))
        return Response(np.arange(4), np.float32(100 + pose) * ONES)

    def sweep(self, camera, pose):
        self.calls.append(("sweep", pose))
        rows = np.arange(8, dtype=np.float32)[:, None, None] + 10 * pose
        return {"proj": Response(np.arange(4), rows * ONES)}


ONES = np.ones((1, 4, 3), np.float32)


@pytest.fixture
def world(tiny_rig, tmp_path):
    shots = []

    def make(camera, shot, exposure):
        shots.append(shot)
        return np.zeros((16, 16, 3), np.uint16)

    world = World(tiny_rig, Lamps(5), Faults(), make, tmp_path / "exposures.jsonl")
    world.shots = shots
    world.arm("cam_a", 0.01)
    yield world
    world.stop()


def poses(world, *steps):
    """The pose at a pulse for each of `steps`: "dark", "all", a lamp's number, or a `Show`."""
    out = []
    for step in steps:
        world.lamps.select({"dark": 0, "all": 65535}.get(step, step) if not _show(step) else 0)
        line = f"LINE {step.projector} {step.row} {step.level}" if _show(step) else "OFF"
        if _show(step) and step.everything:
            line = f"ON {step.level}"
        world.projectors.reply(line)
        world.pulse()
        frame = world.oldest("cam_a")
        frame.counts.result(5)
        world.take("cam_a", frame)
        out.append(world.shots[-1].pose)
    return out


def _show(step):
    return isinstance(step, Show)


def test_pose_advances_with_each_tracking_frame_after_rows(world):
    steps = ["dark", "all", 1, 2, TRACKING, LINE, LINE, TRACKING, LINE, TRACKING, LINE, "dark"]
    assert poses(world, *steps, "all") == [0, 0, 0, 0, 0, 0, 0, 1, 1, 2, 2, 2, 2]


def test_a_repeated_tracking_frame_keeps_its_pose(world):
    assert poses(world, TRACKING, TRACKING, LINE, TRACKING, TRACKING, LINE) == [0, 0, 0, 1, 1, 1]


def test_a_new_capture_begins_at_rest_and_a_resumed_one_does_not(world):
    assert poses(world, TRACKING, LINE, TRACKING, LINE)[-1] == 1
    world.reset()
    assert poses(world, LINE, TRACKING) == [1, 2]
    world.reset()
    assert poses(world, "dark", "all") == [0, 0]
    assert poses(world, LINE, TRACKING, 3) == [0, 1, 0]


def shot(power=(0, 0, 0, 0, 0), show=None, pose=0):
    return Snapshot(1, np.array(power, float), show or Show(), pose)


def value(frames, snapshot):
    image = frames.radiance("cam_a", snapshot).reshape(-1, 3)
    assert not image[4:].any()
    return image[0, 0]


@pytest.fixture
def frames(tiny_rig):
    return FrameMaker(tiny_rig, Counting(), Sensor(), 0)


def test_light_vectors_add_up(frames):
    assert value(frames, shot((1, 0, 0, 0, 0.5))) == pytest.approx(1 + 2.5)
    assert value(frames, shot((1,) * 5, LINE)) == pytest.approx(15 + 2)
    half = Show(32768)
    assert value(frames, shot(show=half)) == pytest.approx(28 * 32768 / 65535)


def test_nothing_is_rendered_for_the_dark(frames):
    assert value(frames, shot()) == 0
    assert value(frames, shot(pose=3)) == 0
    assert frames._responder.calls == []


def test_responses_are_rendered_once_and_old_poses_go(frames):
    for pose in (0, 0, 1, 2, 1, 0):
        value(frames, shot((1,) * 5, LINE, pose))
    assert frames._responder.calls == [
        "lamps",
        ("sweep", 0),
        ("together", 1),
        ("sweep", 1),
        ("together", 2),
        ("sweep", 2),
        ("sweep", 0),
    ]


def test_frames_of_responses_on_disk_are_those_of_responses_in_memory(tiny_rig, frames):
    on_disk = FrameMaker(tiny_rig, Counting(), Sensor(), 0, in_memory=0)
    for power in ((1, 0, 0, 0, 0.5), (1,) * 5):
        same = [x.radiance("cam_a", shot(power)) for x in (frames, on_disk)]
        assert np.array_equal(*same)
    assert isinstance(on_disk._lights["cam_a"].images, np.memmap)


def test_drift_starts_at_rest_and_reaches_the_requested_value():
    drift = Drift(18, 1.5e-3, 4)
    rotation, translation = drift.pose(0)
    assert np.array_equal(rotation, np.eye(3))
    assert not translation.any()
    shifts = [np.linalg.norm(drift.pose(k)[1]) for k in range(18)]
    angles = [np.degrees(np.arccos((np.trace(drift.pose(k)[0]) - 1) / 2)) for k in range(18)]
    assert max(shifts) == pytest.approx(1.5e-3)
    assert max(angles) == pytest.approx(0.4, rel=1e-3)
    steps = [np.linalg.norm(drift.pose(k + 1)[1] - drift.pose(k)[1]) for k in range(40)]
    assert max(steps) < 0.75e-3
    assert not np.array_equal(drift.pose(5)[1], Drift(18, 1.5e-3, 5).pose(5)[1])
    assert np.array_equal(drift.pose(5)[1], Drift(18, 1.5e-3, 4).pose(5)[1])


def test_shot_noise_grows_as_the_full_well_says():
    sensor = Sensor()
    counts = sensor.expose(np.full((200, 200, 3), 1.0), 0.02, (1,)).astype(float)
    signal = 50_000 * 0.02
    assert counts.mean() == pytest.approx(64 + signal, rel=1e-3)
    variance = signal / 2.48 + (4.0 / 2.48) ** 2 + 1 / 12
    assert counts.var() == pytest.approx(variance, rel=0.02)


def test_non_finite_light_is_reported_with_its_place():
    radiance = np.ones((4, 5, 3))
    radiance[2, 3, 1] = np.nan
    with pytest.raises(ValueError, match=r"not a number at \(row, column, channel\) \[2, 3, 1\]"):
        Sensor().expose(radiance, 0.02, (1,))
    radiance[2, 3, 1] = np.inf
    assert Sensor().expose(radiance, 0.02, (1,))[2, 3, 1] == 4095

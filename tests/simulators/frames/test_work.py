"""The predicted rest of the rendering, by a clock of our own."""

from __future__ import annotations

import numpy as np
import pytest

from reconstruction import Camera, Rig
from simulators.frames.responses import Quality, Response
from simulators.frames.work import COSTS, OVERDUE, MeasuredResponder

CAMERAS = tuple(
    Camera.look_at(f"cam_{i}", 10, 10, (0, -1.0, 0.1 * i), (0, 0, 0), 20.0) for i in range(4)
)
RIG = Rig("four", CAMERAS, ())
LIGHTS, SWEEP = COSTS["lights"], COSTS["sweep"]
LIGHTS_S = LIGHTS.call + 100 * 16 * LIGHTS.path
SWEEP_S = SWEEP.call + 100 * 16 * SWEEP.path
"""Seconds predicted for a camera of 100 pixels and 16 paths, after the first."""


class Slow:
    """Renders in `seconds`; `during()` is called in the middle of each call."""

    def __init__(self) -> None:
        self.now, self.seconds, self.said = 50.0, 8.0, list[dict]()
        self.measured: MeasuredResponder | None = None

    def _render(self, camera: str) -> Response:
        self.now += self.seconds / 2
        self.said.append(self.measured.busy(camera))
        self.now += self.seconds / 2
        return Response(np.arange(0), np.zeros((1, 0, 3), np.float32))

    def lights(self, camera: str) -> Response:
        return self._render("cam_2")

    def lights_together(self, camera: str, pose: int, power: np.ndarray) -> Response:
        return self._render(camera)

    def sweep(self, camera: str, pose: int) -> dict[str, Response]:
        return {"proj": self._render("cam_3")}


@pytest.fixture
def slow() -> Slow:
    renders = Slow()
    renders.measured = MeasuredResponder(renders, RIG, Quality(), 2, 18, lambda: renders.now)
    return renders


def test_the_rest_of_a_lane_is_predicted_by_the_calls_that_were_measured(slow):
    # cam_0 and cam_2 are one lane; this machine takes twice as long as was predicted
    slow.seconds = 2 * (LIGHTS.first + LIGHTS_S)
    slow.measured.lights("cam_0")
    first = slow.said[-1]
    assert first["doing"] == "rendering camera 1 of 4"
    late = OVERDUE * slow.seconds / 2  # half of it is over, as much as was predicted
    rest = late * (LIGHTS.first + 2 * LIGHTS_S) / (LIGHTS.first + LIGHTS_S)
    assert first["left_s"] == pytest.approx(rest - slow.seconds / 2)
    slow.seconds = 2 * LIGHTS_S
    slow.measured.lights("cam_2")
    second = slow.said[-1]
    assert second["doing"] == "rendering camera 2 of 4"
    assert second["left_s"] == pytest.approx(LIGHTS_S)
    sweep = SWEEP.first + 2 * SWEEP_S
    assert second["frame_s"]["tracking"] == pytest.approx(2 * sweep), "two cameras a lane"
    assert slow.measured.busy("cam_2") == {}, "its frame is ready"


def test_a_kind_is_predicted_by_its_own_calls(slow):
    slow.seconds = 100.0
    slow.measured.lights("cam_0")
    slow.seconds = SWEEP.first + SWEEP_S
    slow.measured.sweep("cam_1", 3)
    slow.seconds = SWEEP_S
    slow.measured.sweep("cam_3", 3)
    assert slow.said[-1]["doing"] == "rendering camera 2 of 4, pose 4 of 18"
    slow.measured.sweep("cam_1", 4)
    assert slow.said[-1]["left_s"] == pytest.approx(1.5 * SWEEP_S)

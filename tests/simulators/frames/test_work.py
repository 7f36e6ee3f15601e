"""The predicted rest of the rendering, by a clock of our own."""

from __future__ import annotations

import numpy as np
import pytest

from reconstruction import Camera, Rig
from simulators.frames.responses import Quality, Response
from simulators.frames.work import OVERDUE, PER_PATH_S, MeasuredResponder

CAMERAS = tuple(
    Camera.look_at(f"cam_{i}", 10, 10, (0, -1.0, 0.1 * i), (0, 0, 0), 20.0) for i in range(4)
)
RIG = Rig("four", CAMERAS, ())
PATHS_S = 100 * 16 * PER_PATH_S["lights"][0]
"""Seconds predicted for the lights (none) of a camera of 100 pixels and 16 paths."""


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
    # cam_0 and cam_2 are one lane
    slow.measured.lights("cam_0")
    first = slow.said[-1]
    assert first["doing"] == "rendering camera 1 of 4"
    late = OVERDUE * 4.0  # 4 s are over, and more than was predicted
    assert late > PATHS_S
    assert first["left_s"] == pytest.approx(2 * late - 4.0)
    slow.measured.lights("cam_2")
    second = slow.said[-1]
    assert second["doing"] == "rendering camera 2 of 4"
    assert second["left_s"] == pytest.approx(8.0 - 4.0)
    ratio = PER_PATH_S["sweep"][0] / PER_PATH_S["lights"][0]
    assert second["frame_s"]["tracking"] == pytest.approx(2 * 8.0 * ratio), "two cameras a lane"
    assert slow.measured.busy("cam_2") == {}, "its frame is ready"


def test_the_first_call_which_compiles_predicts_no_later_ones(slow):
    slow.seconds = 100.0
    slow.measured.lights("cam_0")
    slow.seconds = 2.0
    slow.measured.lights("cam_2")
    slow.measured.sweep("cam_1", 3)
    slow.measured.sweep("cam_3", 3)
    assert slow.said[-1]["doing"] == "rendering camera 2 of 4, pose 4 of 18"
    slow.measured.sweep("cam_0", 4)
    slow.measured.sweep("cam_1", 4)
    assert slow.said[-1]["left_s"] == pytest.approx(2 * 2.0 - 1.0)
    assert slow.said[-1]["frame_s"]["tracking"] == pytest.approx(2 * 2.0)

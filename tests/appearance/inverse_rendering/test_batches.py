"""Which pairs of camera and light a fit reads."""

from __future__ import annotations

import numpy as np
import pytest

from appearance.inverse_rendering.batches import lit_pairs
from appearance.inverse_rendering.problem import FitProblem
from appearance.observations import Observed
from reconstruction import Camera, Light

PIXELS = 50


def view(brightness, invalid=()):
    """A camera's frames of flat brightness, one a light."""
    camera = Camera.look_at("c", 10, 10, (0, -1, 0), (0, 0, 0), 20)
    lights = tuple(Light(f"l{i}", (0, 0, 1), np.ones(3)) for i in range(len(brightness)))
    radiance = np.ones((len(brightness), PIXELS, 3), np.float32)
    radiance *= np.array(brightness, np.float32)[:, None, None]
    valid = np.ones(radiance.shape[:2], bool)
    valid[list(invalid)] = False
    return Observed(camera, lights, np.arange(PIXELS), radiance, valid)


def test_black_saturated_and_grazing_frames_are_left_out():
    grazing = view([1.0] * 4)
    grazing.radiance[3] = 0
    grazing.radiance[3, :2] = 5
    used = lit_pairs([view([1, 1, 0.001, 1], invalid=[1]), grazing], scale=1.0)
    assert used.tolist() == [[True, False, False, True], [True, True, True, False]]


@pytest.mark.parametrize(("cameras", "wanted"), [(5, 3), (4, 3), (8, 3), (7, 2), (2, 3)])
def test_views_that_decide_are_spread_over_all_cameras(cameras, wanted):
    """Cameras stand in order around the head: no gap between those taken is twice an even one."""
    views = [view([1, 1]) for _ in range(cameras)]
    used, problem = lit_pairs(views, 1.0), FitProblem(None, views, 1.0, np.ones(3))
    taken = [b.view for b in problem.spread(used, wanted, 2)]
    assert len(set(taken)) == len(taken) == min(wanted, cameras)
    gaps = np.diff([*taken, taken[0] + cameras])
    assert gaps.max() < 2 * cameras / len(taken)
    assert gaps.max() - gaps.min() <= 1

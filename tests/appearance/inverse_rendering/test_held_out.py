"""The frames that decide take no part in a fit, and have no noise of renderings in their errors."""

from __future__ import annotations

import numpy as np
import pytest

from appearance.bsdf.maps import HairMaps
from appearance.inverse_rendering.held_out import Split
from appearance.inverse_rendering.options import Effort
from appearance.inverse_rendering.problem import FitProblem
from appearance.inverse_rendering.unknowns import encode
from appearance.observations import Observed
from reconstruction import Camera, Light
from reconstruction.geometry.lights import dome_positions


def problem_of(views: int, lights: int) -> FitProblem:
    """Flat frames, each of its own brightness."""
    stage = tuple(
        Light(f"l{i}", p, np.ones(3)) for i, p in enumerate(dome_positions(lights, 1.0, -60.0))
    )
    out = []
    for k in range(views):
        camera = Camera.look_at(f"c{k}", 10, 10, (0, -1, 0), (0, 0, 0), 20)
        level = 1 + 0.01 * (100 * k + np.arange(lights, dtype=np.float32))
        radiance = np.repeat(level[:, None, None], 50, axis=1).repeat(3, axis=2)
        valid = np.ones(radiance.shape[:2], bool)
        out.append(Observed(camera, stage, np.arange(50), radiance, valid))
    return FitProblem(None, out, 1.0, np.ones(3))


@pytest.mark.parametrize(
    ("views", "lights", "held", "counts"),
    [(7, 16, 4, (6, 12)), (3, 8, 2, (3, 6)), (4, 3, 0, (3, 3)), (1, 1, 0, (1, 1))],
)
def test_no_frame_is_both_fitted_and_held_out(views, lights, held, counts):
    problem = problem_of(views, lights)
    split = Split.of(problem, held)
    fitted = {float(x) for o in split.training.views for x in o.radiance[:, 0, 0]}
    decide = {float(problem.views[k].radiance[i, 0, 0]) for k, i in np.argwhere(split.held_out)}
    assert (len(split.training.views), len(split.training.lights)) == counts
    assert len(fitted) == counts[0] * counts[1]
    assert not fitted & decide
    assert len(fitted | decide) == views * lights


@pytest.mark.slow
@pytest.mark.parametrize(("spp", "most"), [(4, 0.06), (64, 0.04)])
def test_the_error_of_the_truth_is_that_of_smoothing_and_the_least(tufted, spp, most):
    """Hair of ten pixels' width, over which smoothing shows: 0.046 and 0.033 are measured."""
    problem = tufted.problem(spp=4096)
    truth, effort = encode(HairMaps.of(tufted.truth)), Effort(spp=spp, max_depth=6)
    used, error = np.ones((2, 8), bool), []
    for gain in (1.0, 1.1, 1.5):
        squares, counts = problem.squares(truth, np.full(8, gain), used, effort, seed=3)
        assert squares.shape == counts.shape == (2, 9)
        assert counts.sum() == 3 * sum(o.valid.sum() for o in problem.views)
        error.append((squares.sum() / counts.sum()) ** 0.5)
    assert error == sorted(error)
    assert error[0] < most < error[2]


def test_errors_are_those_of_pictures_as_they_are_shown(plain, tufted):
    """Ten times brighter highlights look the same, and a screen's error has 1 at most."""
    guess, used = (encode(HairMaps.of(tufted.truth)), np.ones(8)), np.eye(2, 8, dtype=bool)
    brighter = plain.part(np.arange(2), np.arange(8))
    for o in brighter.views:
        o.radiance[o.radiance * plain.scale > 1] *= 10
    found = [
        p.squares(*guess, used, Effort(spp=16, max_depth=6), seed=3) for p in (plain, brighter)
    ]
    np.testing.assert_array_equal(found[0], found[1])
    assert abs(found[0][0].sum() / found[0][1].sum()) < 0.06**2


def test_saturated_pixels_do_not_count(plain, tufted):
    guess, used = (encode(HairMaps.of(tufted.truth)), np.ones(8)), np.eye(2, 8, dtype=bool)
    found = []
    for value in (0.0, 1e9):
        cut = plain.part(np.arange(2), np.arange(8))
        for o in cut.views:
            o.valid[:, ::2] = False
            o.radiance[:, ::2] = value
        found.append(cut.squares(*guess, used, Effort(spp=16, max_depth=6), seed=3))
        assert (
            found[-1][1].sum() == 3 * cut.views[0].valid[0].sum() + 3 * cut.views[1].valid[1].sum()
        )
    np.testing.assert_array_equal(found[0], found[1])

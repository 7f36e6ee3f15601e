"""Correctives are found where the frames show turned fibres, and left alone where they do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from appearance.bsdf.maps import HairMaps
from appearance.inverse_rendering.correctives import solve_correctives
from appearance.inverse_rendering.options import Effort
from appearance.inverse_rendering.unknowns import decode, encode

EFFORT = Effort(pixels=100, spp=64, max_depth=6)
TURN = np.array([0.15, -0.1])


def solve(tufted, truth: HairMaps, **more):
    """The start, and what is found from five draws of the paths: single ones are 0.06 off."""
    problem = tufted.problem(truth, spp=1024)
    start = replace(truth, rotation=np.zeros_like(truth.rotation))
    raw = encode(start)
    gain = np.ones(len(problem.lights))
    draws = range(0, 5000, 1000)
    return raw, [solve_correctives(problem, raw, gain, EFFORT, seed=s, **more) for s in draws]


@pytest.mark.slow
def test_a_turn_that_all_fibres_share_is_found(tufted):
    rotation = np.broadcast_to(TURN, (1, 1, 1, 2))
    truth = replace(HairMaps.of(tufted.truth), rotation=rotation)
    raw, found = solve(tufted, truth)
    turns = [decode(draw.raw).rotation[0, 0, 0] for draw in found if draw.taken]
    assert len(turns) >= 4
    np.testing.assert_allclose(np.median(turns, axis=0), TURN, atol=0.08)
    assert all(draw.error < draw.start_error for draw in found if draw.taken)
    others = [name for name in raw if name != "rotation"]
    assert all((draw.raw[name] == raw[name]).all() for name in others for draw in found)


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(2, 1, 1), (1, 2, 1)], ids=["layers", "cells"])
@pytest.mark.parametrize(("lambda_r", "apart"), [(1e-4, True), (10.0, False)])
def test_neighbours_are_held_together_by_their_weight(tufted, shape, lambda_r, apart):
    turns = np.array([[0.2, 0.0], [-0.2, 0.0]]).reshape(*shape, 2)
    truth = replace(HairMaps.of(tufted.truth, shape), rotation=turns)
    _, found = solve(tufted, truth, lambda_r=lambda_r)
    one, other = np.median([decode(draw.raw).rotation[..., 0].ravel() for draw in found], axis=0)
    assert (one - other > 0.15) == apart


def test_without_lights_to_judge_by_nothing_is_turned(tufted):
    problem = tufted.problem(lights=tufted.dome(3))
    raw = encode(HairMaps.of(tufted.truth))
    found = solve_correctives(problem, raw, np.ones(3), EFFORT)
    assert found.raw is raw
    assert found.taken == ()

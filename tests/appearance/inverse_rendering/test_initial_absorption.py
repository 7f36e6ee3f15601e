"""Colours of cells, where a picture shows each cell's own colour and noise."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from appearance import HairAppearance
from appearance.bsdf.maps import HairMaps
from appearance.inverse_rendering import initial_absorption
from appearance.inverse_rendering.initial_absorption import absorption_of_cells
from appearance.inverse_rendering.options import Effort
from appearance.inverse_rendering.unknowns import BRACKET, decode, encode

SHAPE = (6, 8, 8)
NOISE = 0.3


@pytest.fixture
def problem(monkeypatch):
    """A pixel for each cell, in which nothing else is seen."""
    count = int(np.prod(SHAPE))
    cells = np.tile(np.arange(count)[:, None], (1, 8))
    monkeypatch.setattr(initial_absorption, "visible_cells", lambda *given: cells)
    radiance = np.broadcast_to((0.2, 0.3, 0.4), (1, count, 3))
    view = SimpleNamespace(
        pixels=np.arange(count), radiance=radiance, valid=np.ones((1, count), bool)
    )

    def render_all(raw, gain, view, effort, seed):
        colour = np.exp(-BRACKET * np.sqrt(decode(raw).sigma_a)).reshape(1, -1, 3)
        return colour * np.exp(NOISE * np.random.default_rng(seed).normal(size=colour.shape))

    return SimpleNamespace(views=[view], scale=1.0, render_all=render_all)


def test_noise_of_rounds_averages_out(problem):
    """Nine of twelve rounds count as their mean: half of the noise, as neighbours share theirs."""
    start = HairMaps.of(HairAppearance((0.01, 0.1, 0.1), 0.3, 0.3), SHAPE)
    raw = encode(start)
    spread = []
    for whole in (12, 4):
        maps = absorption_of_cells(problem, raw, np.ones(1), Effort(), whole=whole)
        colour = np.exp(-BRACKET * np.sqrt(maps.sigma_a))
        np.testing.assert_allclose(np.median(colour, axis=(0, 1, 2)), (0.2, 0.3, 0.4), rtol=0.05)
        spread.append(np.log(colour).std(axis=(0, 1, 2)).mean())
    assert spread[1] < 0.75 * spread[0]

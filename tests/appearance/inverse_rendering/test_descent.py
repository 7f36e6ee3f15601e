"""Cells with a gradient move; cells that see noise alone hardly do."""

from __future__ import annotations

import numpy as np

from appearance.inverse_rendering.descent import STEP, Adam


def test_cells_move_by_what_is_more_than_noise():
    rng = np.random.default_rng(0)
    mean = np.repeat([1.0, 0.0], 200)
    raw = {"sigma_a": np.zeros(400)}
    adam = Adam()
    for _ in range(30):
        adam.step(raw, {"sigma_a": mean + rng.normal(size=400)}, 1.0)
    moved, noise = np.abs(raw["sigma_a"][:200]), np.abs(raw["sigma_a"][200:])
    assert (raw["sigma_a"][:200] < 0).all()
    assert moved.mean() > 0.2 * 30 * STEP["sigma_a"]
    assert noise.mean() < 0.2 * moved.mean()

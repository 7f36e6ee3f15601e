"""The OLAT benchmark's arithmetic, and one small run of it."""

import json

import numpy as np
import pytest

from appearance.bench_olat import relative_mse, run
from appearance.hair_appearance import HairAppearance


def test_the_references_own_noise_is_subtracted():
    rng = np.random.default_rng(0)
    truth = rng.uniform(0.5, 2, (3, 4000, 3))
    power = (truth**2).mean()
    first, second, image = (truth + rng.normal(scale=s, size=truth.shape) for s in (0.3, 0.3, 0.2))
    assert relative_mse(image, first, second) == pytest.approx(0.2**2 / power, rel=0.05)


def test_lights_that_reach_nothing_are_left_out():
    truth = np.ones((2, 10, 3))
    truth[1] = 0
    assert relative_mse(truth * 1.1, truth, truth) == pytest.approx(0.01)
    with pytest.raises(ValueError, match="no light reaches the subject"):
        relative_mse(truth * 0, truth * 0, truth * 0)


def test_a_small_run_writes_both_curves(tmp_path, small):
    result = run(
        tmp_path,
        strands=small.tuft(100),
        head=small.plane(),
        hair=HairAppearance((0.5, 0.6, 0.8), 0.3, 0.3),
        camera=small.camera(),
        lights=small.lamps(),
        pixels=200,
        spp=(2, 8),
        path_spp=(2, 8),
        reference_spp=128,
        max_depth=4,
    )
    assert json.loads((tmp_path / "olat.json").read_text()) == result
    assert (tmp_path / "olat.png").stat().st_size > 5000
    assert [(s["method"], s["spp"]) for s in result["series"]] == [
        ("ours", 2),
        ("ours", 8),
        ("mitsuba path", 2),
        ("mitsuba path", 8),
    ]
    assert result["series"][1]["rel_mse"] < result["series"][0]["rel_mse"]

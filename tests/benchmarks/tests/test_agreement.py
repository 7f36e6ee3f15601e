"""The agreement benchmark: its figures on made-up pictures, and a small part of the capture."""

import json

import numpy as np
import pytest
from benchmarks.renderers.agreement import Renderings, agreement, compare

from reconstruction import Camera


@pytest.fixture
def views():
    """Two cameras, two lights; "bright" is 1.1, 1 and 0.9 times "Cycles", with noise."""
    rng = np.random.default_rng(0)
    out = []
    for k in range(2):
        camera = Camera.look_at(f"cam_{k}", 64, 64, (0, -1, 0), (0, 0, 0), 20)
        pixels = np.flatnonzero(rng.uniform(size=64 * 64) < 0.6)
        shade = 1 + np.sin(pixels // 64 / 9) * np.sin(pixels % 64 / 7)
        truth = (shade * rng.uniform(1, 2, (2, 1)))[None, :, :, None] * np.ones(3)
        noise = rng.normal(scale=0.3, size=(8, *truth.shape[1:]))
        radiance = {"Cycles": truth, "bright": truth * [1.1, 1.0, 0.9] + noise, "noise": 1 + noise}
        out.append(Renderings(camera, (), pixels, radiance))
    return out


def test_ratio_and_correlation_come_with_their_errors(views):
    found = compare(views, "bright", "Cycles")
    want = np.array([1.1, 1.0, 0.9])
    mean = np.mean([v.radiance["Cycles"].mean() for v in views])
    error = 0.3 / np.sqrt(8 * 2 * sum(len(v.pixels) for v in views)) / mean
    for name in ("ratio_seeds", "ratio_tiles"):
        np.testing.assert_allclose(found[name], error, rtol=0.8)
    np.testing.assert_allclose(found["ratio"], want, atol=4 * error)
    assert (np.array(found["correlation"]) > 0.99).all()
    assert (np.array(found["pictures"][0]) <= found["ratio"]).all()
    assert (np.array(found["pictures"][1]) >= found["ratio"]).all()


def test_noise_is_not_correlated(views):
    found = compare(views, "noise", "Cycles")
    beyond = np.abs(found["correlation"]) / np.array(found["correlation_tiles"])
    assert (beyond < 4).all()


@pytest.mark.slow
def test_agrees_with_blender_cycles_and_with_mitsuba(shared_data, tmp_path):
    folder = shared_data("captures/cycles_wavy")
    result = agreement(tmp_path, folder, cameras=(4,), lights=(6, 9), seeds=2, spp=8)
    assert json.loads((tmp_path / "agreement.json").read_text()) == result
    assert (tmp_path / "agreement.png").stat().st_size > 5000
    assert len((tmp_path / "agreement.md").read_text().splitlines()) == 2 + 3 * 3
    for figures in result["pairs"].values():
        np.testing.assert_allclose(figures["ratio"], 1, atol=0.05)
        assert min(figures["correlation"]) > 0.85
        assert max(figures["ratio_tiles"]) < 0.02

"""The renderers' benchmark's arithmetic, and one small run of it."""

import json

import numpy as np
import pytest
from benchmarks.renderers.errors import QUICK, relative_mse, run
from benchmarks.subjects import Subject

from appearance import HairAppearance


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


@pytest.mark.slow
def test_a_small_run_writes_figures_and_plots(tmp_path, small):
    subject = Subject(
        small.tuft(100), small.plane(), HairAppearance((0.5, 0.6, 0.8), 0.3, 0.3), (0.3, 0.3, 0.3)
    )
    result = run(tmp_path, {"tuft": subject}, small.camera(), effort=QUICK)
    assert json.loads((tmp_path / "renderers.json").read_text()) == result
    assert (tmp_path / "renderers.png").stat().st_size > 5000
    tuft = result["subjects"]["tuft"]
    assert tuft["agreement"]["ratio"] == pytest.approx(1, abs=0.1)
    errors = [p["rel_mse"] for p in tuft["lights"]["3"]["series"] if p["method"] == "ours"]
    assert errors[1] < errors[0]

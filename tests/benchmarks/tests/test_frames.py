"""The frames' benchmark's arithmetic."""

import numpy as np
import pytest
from benchmarks.renderers.frames import psnrs

from appearance.metrics.scores import Exposure


def test_noise_of_a_hundredth_is_forty_decibels_whatever_the_exposure():
    rng = np.random.default_rng(0)
    value = rng.uniform(0.1, 0.9, (2, 4000, 3))
    noisy = value + 0.01 * rng.standard_normal(value.shape)

    def radiance(picture):  # sRGB's curve, undone
        return 3.0 * ((picture + 0.055) / 1.055) ** 2.4

    found = psnrs(radiance(noisy), radiance(value), Exposure(1 / 3))
    assert found == pytest.approx([40, 40], abs=0.2)

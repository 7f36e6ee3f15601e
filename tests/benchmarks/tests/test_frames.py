"""The frames' benchmark's arithmetic."""

import numpy as np
import pytest
from benchmarks.renderers.extremes import extremes
from benchmarks.renderers.frames import psnrs
from benchmarks.subjects import Subject

from appearance import HairAppearance
from appearance.metrics.scores import Exposure
from reconstruction import Light, Strands


def test_noise_of_a_hundredth_is_forty_decibels_whatever_the_exposure():
    rng = np.random.default_rng(0)
    value = rng.uniform(0.1, 0.9, (2, 4000, 3))
    noisy = value + 0.01 * rng.standard_normal(value.shape)

    def radiance(picture):  # sRGB's curve, undone
        return 3.0 * ((picture + 0.055) / 1.055) ** 2.4

    found = psnrs(radiance(noisy), radiance(value), Exposure(1 / 3))
    assert found == pytest.approx([40, 40], abs=0.2)


def test_extreme_hair_of_a_subject_of_several_colours_has_the_extreme_absorption():
    points = np.array([[0, 0, 0], [0, 0, 0.1]], np.float32)
    hair, absorption = HairAppearance((0.3, 0.4, 0.6), 0.3, 0.3), np.full((1, 2, 3), 0.4)
    subject = Subject(Strands.from_list([points], 4e-4), None, hair, (0.3, 0.2, 0.1), absorption)
    light = Light("l", np.array([0, -1.0, 0]), np.ones(3))
    white = next(e.subject for e in extremes(subject, [light]) if e.name.startswith("white"))
    assert white.hair.sigma_a == (0, 0, 0)
    assert white.absorption is None, "its maps would replace the colour"

"""2D orientations: exact on synthetic lines, silent where there is no line."""

from __future__ import annotations

import numpy as np
import pytest

from reconstruction.images.orientation import orientations, responses, texture, textures
from reconstruction.reconstruct_options import LogGaborBank

SMALL = LogGaborBank(count=32, spread=2.0)


def grating(
    angle: float, size: int = 64, wavelength: float = 3.0, phase: float = 0.3
) -> np.ndarray:
    """Parallel lines at `angle` from +x towards +y (down)."""
    y, x = np.mgrid[:size, :size]
    across = -np.sin(angle) * x + np.cos(angle) * y
    return 1 + 0.5 * np.cos(2 * np.pi * across / wavelength + phase)


def difference(a: np.ndarray, b: float) -> np.ndarray:
    """Undirected angle between, degrees."""
    d = np.abs(a - b) % np.pi
    return np.degrees(np.minimum(d, np.pi - d))


@pytest.mark.parametrize("degrees", [0.0, 17.3, 45.0, 90.0, 133.7, 179.5])
def test_grating_has_its_own_angle_below_a_bin(degrees: float) -> None:
    mask = np.ones((96, 96), bool)
    found = orientations(grating(np.radians(degrees), 96), mask, LogGaborBank())
    inner = (slice(40, 56), slice(40, 56))  # at its edges a picture is mirrored, lines and all
    assert difference(found.angle[inner], np.radians(degrees)).max() < 0.15  # a bin is 1.4
    assert found.confidence[inner].min() > 0.9


def test_angles_are_undirected_and_in_range() -> None:
    found = orientations(grating(np.radians(179.9)), np.ones((64, 64), bool), SMALL)
    assert found.angle.min() >= 0
    assert found.angle.max() < np.pi


def test_noise_has_little_confidence_and_a_line_much() -> None:
    rng = np.random.default_rng(0)
    mask = np.ones((64, 64), bool)
    noise = orientations(1 + 0.2 * rng.normal(size=(64, 64)), mask, SMALL)
    line = orientations(grating(0.4), mask, SMALL)
    assert np.median(noise.confidence) < 0.5
    assert np.median(line.confidence) > 0.8


def test_flat_image_has_no_confidence() -> None:
    found = orientations(np.full((32, 32), 2.0), np.ones((32, 32), bool), SMALL)
    assert found.confidence.max() < 1e-3


def test_crossing_lightings_are_merged_as_doubled_angles() -> None:
    """2 and 178 degrees average to 0, not to 90."""
    images = np.stack([grating(np.radians(2)), grating(np.radians(178))])
    found = orientations(images, np.ones((64, 64), bool), SMALL)
    assert difference(found.angle[20:44, 20:44], 0.0).max() < 1.0


def test_perpendicular_lightings_cancel() -> None:
    images = np.stack([grating(0.3), grating(0.3 + np.pi / 2)])
    found = orientations(images, np.ones((64, 64), bool), SMALL)
    assert np.median(found.confidence[20:44, 20:44]) < 0.1


@pytest.mark.parametrize("degrees", [0.0, 17.3, 133.7])
def test_lines_under_noise_add_up_over_lightings(degrees: float) -> None:
    """48 noisy pictures of one grating, whose line stands out in none of them."""
    rng = np.random.default_rng(5)
    line = grating(np.radians(degrees), 64, 5.0)
    pictures = 1 + 0.3 * (line - 1) + 0.5 * rng.normal(size=(48, 64, 64))
    mask = np.ones((64, 64), bool)
    bank = LogGaborBank(count=32, spread=1.0, wavelength=5.0)
    errors = difference(orientations(pictures, mask, bank).angle, np.radians(degrees))
    assert np.median(errors[16:48, 16:48]) < 2
    dark = orientations(0 * pictures, mask, bank)
    assert dark.confidence.max() == 0


def test_magnitude_does_not_depend_on_phase() -> None:
    bank = LogGaborBank(count=8, spread=1.0)
    a, b = (responses(bank, grating(0.0, phase=p))[0, 20:44, 20:44] for p in (0.0, np.pi / 2))
    np.testing.assert_allclose(a, b, rtol=0.03)


def test_outline_of_the_mask_is_no_line() -> None:
    """A bright disc on black: its texture within its own mask is nothing."""
    y, x = np.mgrid[:64, :64]
    disc = (x - 32) ** 2 + (y - 32) ** 2 < 20**2
    assert np.abs(texture(np.where(disc, 5.0, 0.0), disc)).max() < 1e-4


def test_texture_does_not_depend_on_exposure() -> None:
    mask = np.ones((48, 48), bool)
    image = grating(0.7, 48)
    np.testing.assert_allclose(texture(1e-3 * image, mask), texture(image, mask), atol=1e-5)


@pytest.mark.parametrize("photons", [100.0, 1e4], ids=["noise", "little noise"])
def test_lines_are_found_beside_many_dark_pictures(photons: float) -> None:
    """One picture is lit; twenty have a hundredth of its light, photon noise and read noise."""
    rng, mask = np.random.default_rng(0), np.ones((64, 64), bool)
    light = photons * (1 + 0.4 * (grating(0.7, wavelength=6.0) - 1))
    pictures = [rng.poisson(p) + rng.normal(size=p.shape) for p in [light, *[1e-2 * light] * 20]]
    bank = LogGaborBank(wavelength=6.0, count=24, spread=1.5)
    found = responses(bank, textures(pictures, [mask] * 21)).argmax(axis=0) * np.pi / 24
    off = difference(found, 0.7)[8:-8, 8:-8]
    assert (off < 10).mean() > 0.9  # unweighted .48 with noise


def test_pictures_of_one_brightness_weigh_alike() -> None:
    mask = np.ones((48, 48), bool)
    pictures = [grating(0.7, 48), 1e3 * grating(0.7, 48)]
    same = textures([pictures[0]] * 3, [mask] * 3)
    np.testing.assert_allclose(same, np.stack([texture(pictures[0], mask)] * 3), rtol=1e-5)
    bright = textures(pictures, [mask] * 2)
    np.testing.assert_allclose(bright.mean(axis=0), texture(pictures[0], mask), atol=1e-5)
    assert not textures([np.zeros((48, 48))] * 2, [mask] * 2).any()


def test_wrong_shapes_and_banks_are_refused() -> None:
    with pytest.raises(ValueError, match="expected images"):
        orientations(np.ones((2, 8, 8)), np.ones((9, 9), bool))
    with pytest.raises(ValueError, match="wavelength"):
        LogGaborBank(wavelength=1.0)


def test_a_saturated_streak_does_not_turn_a_line() -> None:
    """A highlight that runs across the fibres, cut flat, is left out where it is."""
    picture = 1 + 0.2 * grating(np.radians(30.0))
    cut = picture.copy()
    cut[28:36] = 4.0
    clipped = cut >= 4.0
    mask, far = np.ones(cut.shape, bool), np.zeros(cut.shape, bool)
    far[20:44] = True  # the streak's neighbourhood
    truth = orientations(picture, mask, SMALL).angle
    left_out = orientations(cut[None], mask, SMALL, known=~clipped[None]).angle
    taken = orientations(cut, mask, SMALL).angle
    near = far & ~clipped
    assert np.median(difference(left_out, truth)[near]) < 3
    assert np.median(difference(taken, truth)[near]) > 10

"""Unconstrained numbers decode to the maps that they encode, and their derivatives are right."""

from __future__ import annotations

import numpy as np
import pytest

from appearance import HairAppearance
from appearance.bsdf.maps import HairMaps
from appearance.inverse_rendering import losses
from appearance.inverse_rendering.unknowns import decode, derivatives, encode
from appearance.metrics.scores import srgb
from reconstruction import Model, ModelError


def maps(sigma_a=(0.1, 0.2, 0.4), beta=0.3, shape=(3, 2, 2)):
    rng = np.random.default_rng(0)
    out = HairMaps.of(HairAppearance(sigma_a, beta, beta), shape)
    return HairMaps(
        out.sigma_a * rng.uniform(0.9, 1.1, out.sigma_a.shape),
        rng.normal(scale=0.05, size=out.rotation.shape),
        out.beta_m,
        out.beta_n,
    )


@pytest.mark.parametrize("sigma_a", [(8.0, 12.0, 20.0), (0.1, 0.2, 0.4), (1e-4, 5e-4, 2e-3)])
@pytest.mark.parametrize("beta", [0.02, 0.3, 0.9])
def test_black_white_sharp_and_rough_hair_survive_the_way_there_and_back(sigma_a, beta):
    wanted = maps(sigma_a, beta)
    raw = encode(wanted)
    found = decode(raw)
    np.testing.assert_allclose(found.sigma_a, wanted.sigma_a, rtol=1e-3)
    np.testing.assert_allclose(found.rotation, wanted.rotation, atol=1e-9)
    assert (found.beta_m, found.eta) == (pytest.approx(beta), pytest.approx(1.55))
    assert found.tilt_deg == pytest.approx(2.0)
    for name, gradient in derivatives(raw).items():
        up, down = (decode(raw | {name: raw[name] + step}) for step in (1e-4, -1e-4))
        change = (np.atleast_1d(getattr(up, name)) - getattr(down, name)) / 2e-4
        np.testing.assert_allclose(gradient, change, rtol=1e-5)


def test_the_loss_is_of_differences_as_they_are_displayed():
    level = np.array([[[0.05, 0.2, 0.8]]])
    step = 0.01 * level
    shown = srgb(level + step) - srgb(level)
    squares = (step**2 * losses.weights(level)).mean()
    assert squares == pytest.approx((shown**2).mean(), rel=0.4)


def test_resizing_keeps_what_is_linear_along_the_strand_and_flat_on_the_scalp():
    base = maps(shape=(2, 2, 2))
    up = base.resized((5, 4, 4))
    np.testing.assert_allclose(up.sigma_a[2].mean((0, 1)), base.sigma_a.mean((0, 1, 2)), rtol=1e-6)
    np.testing.assert_allclose(up.sigma_a[0, 0, 0], base.sigma_a[0, 0, 0])
    assert up.resized((1, 1, 1)).shape == (1, 1, 1)


def test_maps_are_saved_with_the_strands_places_and_bad_ones_refused(tmp_path):
    wanted, uv = maps(), np.random.default_rng(0).uniform(size=(7, 2))
    wanted.save(Model(tmp_path), uv)
    found, places = HairMaps.load(Model(tmp_path))
    np.testing.assert_allclose(found.sigma_a, wanted.sigma_a, rtol=1e-6)
    np.testing.assert_allclose(places, uv, atol=1e-6)
    with pytest.raises(ModelError, match="hairstage fit"):
        HairMaps.load(Model(tmp_path / "none"))
    with pytest.raises(ValueError, match="sigma_a must be"):
        HairMaps(np.ones((2, 2, 3)), np.zeros((1, 1, 1, 2)), 0.3, 0.3)
    with pytest.raises(ValueError, match="negative"):
        HairMaps(-np.ones((1, 1, 1, 3)), np.zeros((1, 1, 1, 2)), 0.3, 0.3)


def test_noisy_light_counts_less_and_all_together_as_much():
    rng = np.random.default_rng(2)
    weight, level = np.ones((1, 500, 3)), rng.uniform(size=(1, 500, 3))
    weight[:, 400:] = 0  # not valid
    squares = rng.exponential(size=weight.shape)
    level[:, 100:120] += 2
    squares[:, 100:120] *= 1e4
    quiet = losses.noise_weighted(weight, squares, level)
    assert quiet.sum() == pytest.approx(weight.sum())
    assert quiet[:, 100:120].max() < 0.01 * np.median(quiet[:, :400])
    assert (quiet[:, 400:] == 0).all()
    for nothing in (np.zeros_like(weight), weight):
        assert (losses.noise_weighted(nothing, np.zeros_like(weight), level) == nothing).all()


def test_weights_do_not_depend_on_which_of_two_equally_bright_pixels_is_noisy():
    rng = np.random.default_rng(3)
    level = rng.uniform(size=(2, 3000, 3))
    rendered_bright = rng.uniform(size=level.shape[:2]) < 0.5  # the captured image is, elsewhere
    squares = np.where(rendered_bright[..., None], 100.0, 0.01) * rng.exponential(size=level.shape)
    found = losses.noise_weighted(np.ones_like(level), squares, level)
    one, other = found[rendered_bright].mean(), found[~rendered_bright].mean()
    assert one == pytest.approx(other, rel=0.05)

"""Harmonics, and pictures under a field: environments are the sums of their lights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import sph_harm_y
from scipy.stats import special_ortho_group

from appearance import (
    Environment,
    HairAppearance,
    Sampling,
    build_scene,
    render_environment,
    render_mixed,
    render_olat,
)
from appearance.render.coverage import covered_pixels
from appearance.render.harmonics import count_of, harmonics, turns
from appearance.render.pixel_field import PixelField
from appearance.render.smoothed import environment_smoothed, olat_smoothed
from reconstruction import Light

BLACK = HairAppearance((8.0, 8.0, 8.0), 0.3, 0.3)


def test_harmonics_are_scipys():
    d = np.random.default_rng(0).normal(size=(50, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    theta, phi = np.arccos(d[:, 2]), np.arctan2(d[:, 1], d[:, 0])
    k = 0
    for degree in range(4):
        for m in range(-degree, degree + 1):
            y = sph_harm_y(degree, abs(m), theta, phi)
            part = y.real if m >= 0 else y.imag
            expected = part * (1 if m == 0 else (-1) ** m * np.sqrt(2))
            np.testing.assert_allclose(harmonics(d, 3)[:, k], expected, atol=1e-6)
            k += 1
    with pytest.raises(ValueError, match="0 to 3, got 4"):
        harmonics(d, 4)


def test_turned_harmonics_are_those_of_the_direction_in_the_frame():
    rng = np.random.default_rng(0)
    frames, d = special_ortho_group.rvs(3, 6, rng), rng.normal(size=3)
    local = np.einsum("i,hij->hj", d, frames)
    world = harmonics(d, 3)
    for degree, block in enumerate(turns(frames, 3), 1):
        part = slice(degree**2, (degree + 1) ** 2)
        found = block @ world[part]
        np.testing.assert_allclose(found, harmonics(local, 3)[:, part], atol=2e-6)
        np.testing.assert_allclose(
            block @ block.transpose(0, 2, 1), [np.eye(2 * degree + 1)] * 6, atol=3e-6
        )


class Planted:
    """A field of given coefficients in every pixel, about the origin."""

    def __init__(self, coefficients, **kind):
        self.coefficients, self.kind = np.asarray(coefficients, np.float32), kind

    def at_pixels(self, scene, camera, pixels):
        shape = (len(pixels), *self.coefficients.shape)
        every = np.broadcast_to(self.coefficients, shape).copy()
        # a pixel's own, so that a mix-up of pixels shows
        every *= (1 + pixels % 2)[:, None, None]
        return PixelField(every, np.zeros((len(pixels), 3), np.float32), **self.kind)


@pytest.fixture(scope="module")
def observed(small):
    """The tuft with a modulation of degree 2 and with an additive field; neither falls below 0."""
    rng = np.random.default_rng(3)
    c = rng.uniform(-0.12, 0.12, (count_of(2), 3))
    added = 0.05 * c
    added[0] = 0.1
    scene = build_scene(small.tuft(150), None, hair=BLACK)
    return replace(scene, field=Planted(c)), replace(scene, field=Planted(added, additive=True))


def patch(row, column, shape=(8, 16)):
    """A map that is bright in one texel."""
    out = np.zeros((*shape, 3), np.float32)
    out[row, column] = (40, 60, 20)
    return out


@pytest.mark.parametrize("kind", [0, 1])
def test_a_map_shows_the_sum_of_its_lights(observed, small, kind):
    """Each texel as distant lights, fine enough that they tell nothing of its size."""
    scene, camera = observed[kind], small.camera(size=8)
    envmap = patch(2, 3) + patch(5, 11)
    far, lights = 200.0, []
    rows, columns = np.nonzero(envmap[..., 0])
    for row, column in zip(rows, columns, strict=True):
        fine = (np.arange(4) + 0.5) / 4
        z = np.cos(np.pi * np.linspace(row, row + 1, 5) / 8)
        for i in range(4):
            for x in fine:
                angle = (0.5 - (column + x) / 16) * 2 * np.pi
                middle = 0.5 * (z[i] + z[i + 1])
                radius = np.sqrt(1 - middle**2)
                d = np.array([radius * np.cos(angle), radius * np.sin(angle), middle])
                area = (z[i] - z[i + 1]) * 2 * np.pi / 16 / 4
                watts = envmap[row, column] * area * far**2
                lights.append(Light(f"{len(lights)}", d * far, watts))
    few, bare = Sampling(1024, 3), replace(scene, field=None)
    pixels = covered_pixels(scene, camera)

    def olat(scene):
        return render_olat(scene, camera, lights, spp=64, max_depth=3, pixels=pixels, thrift=0)

    pictures = {
        "map": lambda scene: render_environment(scene, camera, envmap, few),
        "mixed": lambda scene: render_mixed(scene, camera, [], [Environment(envmap)], few),
        "smoothed": lambda scene: environment_smoothed(scene, camera, envmap, Sampling(32, 3)),
    }
    # smoothed pictures scatter the mean over a fibre's width, which shifts the lights' balance
    bounds = {"map": 0.01, "mixed": 0.01, "smoothed": 0.015}
    # with and without the field of the same paths: what the field does, almost without noise
    parts, plain = olat(scene).sum(0), olat(bare).sum(0)
    for parity in (0, 1):
        some = pixels % 2 == parity
        unit = np.ones(3) if kind else plain[some].sum(0)
        change = (parts[some].sum(0) - plain[some].sum(0)) / unit
        assert np.abs(change).max() > 0.02, "the field shows"
        for name, picture in pictures.items():
            shown, without = (picture(x).reshape(-1, 3)[pixels[some]].sum(0) for x in (scene, bare))
            off = (shown - without) / (unit if kind else without) - change
            assert np.abs(off).max() < (0.01 * np.abs(change).max() if kind else bounds[name]), name


def test_smoothed_single_lights_have_the_field_in_full_detail(observed, small):
    scene, camera = observed[0], small.camera(size=10)
    pixels, lights = covered_pixels(scene, camera), small.lights()
    few, bare = Sampling(16, 3), replace(scene, field=None)
    plain = olat_smoothed(bare, camera, lights, few, pixels=pixels)
    shown = olat_smoothed(scene, camera, lights, few, pixels=pixels)
    field = scene.field.at_pixels(scene, camera, pixels)
    np.testing.assert_allclose(shown, field.lit(plain, lights), rtol=1e-5)
    one, without = (
        render_mixed(x, camera, lights[:1], [], few).reshape(-1, 3)[pixels] for x in (scene, bare)
    )
    np.testing.assert_allclose(one, field.lit(without[None], lights[:1])[0], rtol=1e-4)
    darkest = PixelField(-50 * np.abs(field.coefficients), field.points)
    assert (darkest.lit(plain, lights) >= 0).all()

"""Kept paths make the picture that tracing makes, and its exact derivatives."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from appearance import HairAppearance, build_scene, render_olat
from appearance.bsdf.maps import HairMaps, MappedStrands, scalp_coordinates
from appearance.inverse_rendering.linearised import SHARED, LinearisedPictures, half_of
from appearance.render.cached_paths import CachedSampling, WeightedPixels, cache_paths
from appearance.render.coverage import coverage
from appearance.scene.hair_scene import light_arrays
from reconstruction import Camera, Light

HAIR = HairAppearance((0.06, 0.12, 0.3), 0.25, 0.35)
DEPTH = 5
SHAPE = (2, 2, 1)


@pytest.fixture(scope="module")
def tuft(small):
    """A tuft with maps that vary, over a board, its camera, lights and pixels."""
    strands, board = small.tuft(300), small.plane()
    board = replace(board, vertices=board.vertices + np.array([0, 0, -0.035]))
    scene = build_scene(strands, board, hair=HAIR, skin=(0.6, 0.5, 0.4))
    mapped = MappedStrands.of(scene, strands, scalp_coordinates(strands, None))
    maps = HairMaps.of(HAIR, SHAPE)
    rng = np.random.default_rng(0)
    maps = replace(
        maps,
        sigma_a=maps.sigma_a * rng.uniform(0.5, 2, maps.sigma_a.shape),
        rotation=rng.normal(scale=0.1, size=maps.rotation.shape),
    )
    d = rng.normal((0, -0.5, 1), size=(4, 3))
    lights = [
        Light(f"l{i}", x / np.linalg.norm(x), np.array([5.0, 4.0, 3.0])) for i, x in enumerate(d)
    ]
    camera = Camera.look_at("c", 16, 16, (0, -0.5, 0.1), (0, 0, 0.0), 12)
    pixels = np.flatnonzero((coverage(scene, camera)["hair"] > 0.5).ravel())
    return mapped, maps, camera, lights, pixels


def kept(tuft, spp, maps=None, seed=1, names=(*SHARED, "rotation")):
    """Paths, drawn with the tuft's own maps, and their pictures with `maps`."""
    mapped, own, camera, lights, pixels = tuft
    wanted = WeightedPixels(pixels, np.full((len(lights), len(pixels)), 0.3))
    scene = mapped.with_maps(own)
    paths = cache_paths(scene, camera, lights, wanted, CachedSampling(spp, DEPTH), seed)
    intensities = light_arrays(lights)[1]
    return paths, LinearisedPictures(paths, mapped, maps or own, intensities, names)


def test_their_mean_is_the_picture_that_is_traced(tuft):
    mapped, maps, camera, lights, pixels = tuft
    scene = mapped.with_maps(maps)
    traced = render_olat(scene, camera, lights, spp=1024, max_depth=DEPTH, pixels=pixels)
    halves = kept(tuft, 256)[1].picture()
    by_light = halves.mean(axis=(0, 2)) / traced.mean(axis=1)
    np.testing.assert_allclose(by_light, 1, atol=0.06)
    np.testing.assert_allclose(halves.mean() / traced.mean(), 1, atol=0.02)
    # both halves are of the whole pixel, and of noise of their own
    np.testing.assert_allclose(halves[0].mean() / halves[1].mean(), 1, atol=0.05)


@pytest.mark.parametrize("name", ["sigma_a", "beta_m", "beta_n", "eta", "rotation"])
def test_derivatives_are_those_of_the_same_paths_with_other_hair(tuft, name):
    _, maps, *_ = tuft
    value = getattr(maps, name)
    by = 2e-3 * value * (np.arange(1, 4) if name == "sigma_a" else 1)
    paths, pictures = kept(tuft, 4)
    more, less = (kept(tuft, 4, replace(maps, **{name: value + s * by}))[1] for s in (1, -1))
    wanted = 0.5 * (more.picture() - less.picture())
    found = pictures.change({name: by})
    np.testing.assert_allclose(found, wanted, atol=2e-3 * np.abs(wanted).max())
    assert len(paths.starts) > 2
    first = pictures.change({name: by}, first_hit=True)
    assert 0 < np.abs(first).sum() < np.abs(found).sum() * 2
    assert (first != found).any()


def test_the_gradient_by_correctives_is_the_transpose_of_the_change(tuft):
    _, maps, *_ = tuft
    _, pictures = kept(tuft, 4)
    rng = np.random.default_rng(1)
    weight = rng.normal(size=pictures.picture().shape)
    moved = rng.normal(size=maps.rotation.shape)
    one = (weight * pictures.change({"rotation": moved}, first_hit=True)).sum()
    other = (pictures.rotation_gradient(weight, maps.shape) * moved).sum()
    np.testing.assert_allclose(other, one, rtol=1e-4)


def test_the_same_seed_keeps_the_same_bytes(tuft):
    one, other, third = (kept(tuft, 2, seed=s)[0] for s in (1, 1, 2))
    assert (one.lit.direction == other.lit.direction).all()
    assert (one.incoming == other.incoming).all()
    assert one.nbytes == other.nbytes > 0
    assert one.lit.scale.shape != third.lit.scale.shape or (one.lit.scale != third.lit.scale).any()


@pytest.mark.parametrize("spp", [2, 4, 8, 9, 16, 25, 64, 128])
def test_halves_of_a_pixel_are_of_like_size_and_evenly_spread(spp):
    samples = np.arange(spp)
    half = half_of(samples)
    assert abs((half == 0).sum() - (half == 1).sum()) <= 1
    side = int(spp**0.5)
    if side > 1:
        column = samples[: side**2] % side
        means = [column[half[: side**2] == h].mean() for h in (0, 1)]
        assert abs(means[0] - means[1]) < 0.5

"""Light between fibres from the viewer's grid, beside the path tracer's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from appearance import build_scene
from appearance.render.coverage import coverage, covered_pixels
from appearance.render.harmonics import harmonics
from appearance.render.olat import render_indirect
from reconstruction import Camera, Light
from reconstruction.geometry.lights import dome_positions
from simulators.subject.subject import make_subject
from stage_service.viewer.indirect import DEGREE, BakeOptions, bake, between_lights, mean_places

LIGHTS = [Light(f"l{i}", p, (6, 5, 4)) for i, p in enumerate(dome_positions(60, 1.3))]
LITTLE = BakeOptions(size=20, views=24, lights=32, spp=48, cells=12)


@pytest.fixture(scope="module")
def some_hair():
    """The scene of some hair, and the box that it fills."""
    subject = make_subject("wavy", 1, strands=400)
    scene = build_scene(subject.strands, subject.head, hair=subject.hair, skin=subject.skin)
    box = tuple(f(subject.strands.points, axis=0).astype(float) for f in (np.min, np.max))
    return scene, box


@pytest.fixture(scope="module")
def lit(some_hair):
    """The grid of some hair, the scene, and the box that it fills."""
    scene, box = some_hair
    return bake(scene, box, LIGHTS, LITTLE), scene, box


def test_the_grid_knows_more_of_a_new_view_than_an_even_guess(lit):
    """Under lights of which half were not baked. The guess is the best that one colour can be; what
    is the same to every side knows less, too."""
    grid, scene, (low, high) = lit
    camera = Camera.look_at("new", 32, 32, [0.5, -0.8, 0.3], (low + high) / 2, 22)
    pixels, some = covered_pixels(scene, camera), LIGHTS[3::8]
    one, other = (
        render_indirect(scene, camera, some, pixels, spp=64, max_depth=24, seed=s) for s in (8, 9)
    )
    places, share = mean_places(scene, camera, pixels, 3)
    x, y, z = np.rint((places - low) / (high - low) * (LITTLE.cells - 1)).astype(int).T.clip(0, 11)
    towards = harmonics(camera.center - places, DEGREE)
    hair = coverage(scene, camera)["hair"].ravel()[pixels] > 0.5
    one, other = one[:, hair], other[:, hair]
    guess = one.mean(axis=(0, 1))
    error = even = aside = 0.0
    sums = np.zeros(2)
    for light, a, b in zip(some, one, other, strict=True):
        irradiance = light.intensity / (light.position @ light.position)
        cells = grid.lit(light.position[None], irradiance[None])
        terms = cells[z, y, x] * towards[..., None]
        found = (terms.sum(axis=1) * share[:, None])[hair]
        same = (terms[:, 0] * share[:, None])[hair]
        error += ((found - a) * (found - b)).mean()  # free of their noise
        even += ((guess - a) * (guess - b)).mean()
        aside += ((same - a) * (same - b)).mean()
        sums += found.sum(), a.sum()
    assert error < 0.85 * even
    assert error < 0.9 * aside
    assert sums[0] == pytest.approx(sums[1], rel=0.4)


def test_where_nothing_is_there_is_no_light(lit):
    _, scene, _ = lit
    far = np.array([5.0, 5.0, 5.0])
    grid = bake(scene, (far, far + 0.1), LIGHTS, BakeOptions(size=4, views=1, lights=16, cells=2))
    assert not grid.lit(LIGHTS[0].position[None], np.ones((1, 3))).any()


def test_a_lamp_of_one_colour_makes_of_it_what_a_white_one_does(some_hair):
    """Light adds up: nothing of the colours that it has not, and the other lamps are no darker."""
    scene, box = some_hair
    options = BakeOptions(size=8, views=4, lights=6, spp=8, cells=4)
    white = LIGHTS[::10]
    red = [replace(white[0], intensity=(6, 0, 0)), *white[1:]]
    places = np.array([x.position for x in white])
    expected, found = (
        np.stack([bake(scene, box, x, options).lit(places[:1], np.array([c])) for c in np.eye(3)])
        for x in (white, red)
    )
    assert np.isfinite(found).all()
    assert found[0, ..., 0].any()
    assert not found[0, ..., 1:].any()
    for k in range(3):  # the irradiance is given: of a colour that it has, the same is told
        np.testing.assert_allclose(found[k], expected[k], atol=0.05 * expected.max())


def test_between_lights_what_is_smooth_is_found():
    """A light that is known has its own; what is the same under all lights is that elsewhere."""
    known = np.array([x.position for x in LIGHTS])
    others = dome_positions(40, 1.0)
    weights = between_lights(known, others)
    np.testing.assert_allclose(weights @ np.ones(len(known)), 1, rtol=1e-6)

    def smooth(p):
        x, y, z = np.moveaxis(p / np.linalg.norm(p, axis=-1, keepdims=True), -1, 0)
        return 1 + 0.5 * x + 0.3 * y * z + x * z

    inside = (others / np.linalg.norm(others, axis=1, keepdims=True)) @ [0, 0, 1] > 0
    found = weights @ smooth(known)
    np.testing.assert_allclose(found[inside], smooth(others)[inside], atol=0.05)

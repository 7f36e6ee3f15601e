"""Light between fibres from the viewer's grid, beside the path tracer's."""

from __future__ import annotations

import numpy as np
import pytest

from appearance import build_scene
from appearance.render.coverage import coverage, covered_pixels
from appearance.render.olat import render_olat_parts
from reconstruction import Camera, Light
from reconstruction.geometry.lights import dome_positions
from simulators.subject.subject import make_subject
from stage_service.viewer.indirect import BakeOptions, bake, mean_places

LIGHTS = [Light(f"l{i}", p, (6, 5, 4)) for i, p in enumerate(dome_positions(60, 1.3))]
LITTLE = BakeOptions(size=24, views=8, lights=16, spp=16, cells=12)


@pytest.fixture(scope="module")
def lit():
    """The grid of some hair, the scene, and the box that it fills."""
    subject = make_subject("wavy", 1, strands=400)
    scene = build_scene(subject.strands, subject.head, hair=subject.hair, skin=subject.skin)
    box = tuple(f(subject.strands.points, axis=0).astype(float) for f in (np.min, np.max))
    return bake(scene, box, LIGHTS, LITTLE), scene, box


def test_the_grid_knows_more_of_a_new_view_than_an_even_guess(lit):
    """Under lights of which most were not baked; the guess is the best that one colour can be."""
    grid, scene, (low, high) = lit
    camera = Camera.look_at("new", 32, 32, [0.5, -0.8, 0.3], (low + high) / 2, 22)
    pixels, some = covered_pixels(scene, camera), LIGHTS[3::8]
    one, other = (
        render_olat_parts(scene, camera, some, pixels, spp=64, max_depth=24, seed=s)[1]
        for s in (8, 9)
    )
    places, share = mean_places(scene, camera, pixels, 3)
    x, y, z = np.rint((places - low) / (high - low) * (LITTLE.cells - 1)).astype(int).T.clip(0, 11)
    hair = coverage(scene, camera)["hair"].ravel()[pixels] > 0.5
    one, other = one[:, hair], other[:, hair]
    guess = one.mean(axis=(0, 1))
    error = even = 0.0
    sums = np.zeros(2)
    for light, a, b in zip(some, one, other, strict=True):
        irradiance = light.intensity / (light.position @ light.position)
        cells = grid.lit(light.position[None], irradiance[None])
        found = (cells[z, y, x] * share[:, None])[hair]
        error += ((found - a) * (found - b)).mean()  # free of their noise
        even += ((guess - a) * (guess - b)).mean()
        sums += found.sum(), a.sum()
    assert error < 0.9 * even
    assert sums[0] == pytest.approx(sums[1], rel=0.5)


def test_where_nothing_is_there_is_no_light(lit):
    _, scene, _ = lit
    far = np.array([5.0, 5.0, 5.0])
    grid = bake(scene, (far, far + 0.1), LIGHTS, BakeOptions(size=4, views=1, lights=16, cells=2))
    assert not grid.lit(LIGHTS[0].position[None], np.ones((1, 3))).any()

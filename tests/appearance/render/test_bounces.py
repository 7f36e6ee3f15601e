"""The bounce limit against what longer paths bring."""

import numpy as np
import pytest

from appearance import HairAppearance, build_scene, render_olat
from appearance.render.bounces import bounce_limit
from appearance.render.coverage import covered_pixels
from reconstruction import Camera, Light
from reconstruction.geometry.lights import dome_positions

BLACK, BLOND, WHITE = (
    HairAppearance(sigma_a, 0.3, 0.3)
    for sigma_a in ((3.4, 5.6, 11.0), (0.06, 0.1, 0.2), (0.0, 0.0, 0.0))
)


def test_dark_hair_needs_few_bounces_and_white_hair_many(small):
    scene = build_scene(small.tuft(), None, hair=BLACK)
    limits = [bounce_limit(scene.with_hair(h), small.camera()) for h in (BLACK, BLOND, WHITE)]
    assert 1 < limits[0].depth <= 5 < limits[1].depth < limits[2].depth < 200
    assert all(0 <= x.left_out <= x.bound <= 2e-3 for x in limits)


def test_the_bounce_limit_omits_the_predicted_light(small):
    """Over lights all around, the same paths with and without the limit."""
    scene, camera = build_scene(small.tuft(), None, hair=BLOND), small.camera()
    lights = [Light(f"l{i}", p, np.ones(3)) for i, p in enumerate(dome_positions(64, 3.0))]
    pixels = covered_pixels(scene, camera)
    limit = bounce_limit(scene, camera, 0.05)
    whole, cut = (
        render_olat(scene, camera, lights, spp=16, pixels=pixels, thrift=0, max_depth=depth)
        for depth in (100, limit.depth)
    )
    lost = 1 - cut.mean((0, 1), float) / whole.mean((0, 1), float)
    assert lost.max() == pytest.approx(limit.left_out, rel=0.4)


def test_a_plane_hands_no_light_on(small):
    scene = build_scene(small.no_hair, small.plane(), hair=BLOND)
    assert bounce_limit(scene, small.camera()).depth == 1


def test_nothing_in_view_needs_no_bounces(small):
    scene = build_scene(small.tuft(), None, hair=BLOND)
    away = Camera.look_at("away", 8, 8, (0, 0, 1.0), (0, 0, 2.0), 20)
    assert bounce_limit(scene, away).depth == 1
    with pytest.raises(ValueError, match="between 0 and 1"):
        bounce_limit(scene, away, 0.0)

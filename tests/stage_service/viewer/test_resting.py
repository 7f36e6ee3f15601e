"""Light between fibres in one view, beside the path tracer's."""

from __future__ import annotations

import numpy as np
import pytest

from appearance import build_scene
from appearance.render.coverage import coverage
from appearance.render.olat import render_indirect, spread_out
from reconstruction import Camera, Light
from simulators.subject.subject import make_subject
from stage_service.viewer.resting import RestOptions, indirect_in_view

LIGHTS = [
    (Light("left", [-1.2, -0.4, 0.3], (6, 5, 4)), np.array([1.0, 0.5, 0.0])),
    (Light("above", [0.2, -0.5, 1.2], (2, 2, 2)), np.array([0.2, 1.0, 1.5])),
]
CAMERA = Camera.look_at("side", 48, 40, [0.5, -0.8, 0.3], [0.05, -0.05, 0.05], 10)


@pytest.fixture(scope="module")
def scene():
    subject = make_subject("wavy", 1, strands=400)
    return build_scene(subject.strands, subject.head, hair=subject.hair, skin=subject.skin)


def traced(scene, seed: int) -> np.ndarray:
    """What comes by way of others `(H, W, 3)`."""
    lights, pixels = [light for light, _ in LIGHTS], np.arange(CAMERA.width * CAMERA.height)
    light = render_indirect(scene, CAMERA, lights, pixels, spp=128, max_depth=24, seed=seed)
    weights = np.array([weight for _, weight in LIGHTS])
    return spread_out(np.einsum("lpc,lc->pc", light, weights)[None], pixels, CAMERA)[0]


def test_it_is_the_path_tracers_light_of_hair_and_of_head(scene):
    found = indirect_in_view(scene, CAMERA, LIGHTS, RestOptions(spp=64))
    one, other = traced(scene, 8), traced(scene, 9)
    share = coverage(scene, CAMERA, 64)
    assert ((found[0, ..., 3] > 0) == (found[1, ..., 3] > 0)).all()  # something is known of all
    for part, other_part, kind in zip(found, found[::-1], ("hair", "head"), strict=True):
        visible = part[..., 3] > other_part[..., 3]
        assert np.abs(part[visible, 3] - share[kind][visible]).mean() < 0.1
        total = (one + other)[visible].sum(axis=0) / 2
        np.testing.assert_allclose(part[visible, :3].sum(axis=0), total, rtol=0.15)
        much = visible & (part[..., 3] > 0.5)
        a, b, light = one[much], other[much], part[much, :3]
        even = (a + b).mean(axis=0) / 2
        error = ((light - a) * (light - b)).mean()  # free of their noise
        assert error < 0.35 * ((even - a) * (even - b)).mean()


def test_without_light_or_beside_the_subject_there_is_none(scene):
    assert not indirect_in_view(scene, CAMERA, [], RestOptions())[..., :3].any()
    away = Camera.look_at("away", 8, 8, [0, -2, 0], [0, -5, 0], 20)
    assert not indirect_in_view(scene, away, LIGHTS, RestOptions()).any()

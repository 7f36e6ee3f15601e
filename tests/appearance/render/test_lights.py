"""Lights: irradiance in closed form, soft shadows, profiles on the device, mixtures."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from appearance import (
    Environment,
    HairAppearance,
    Sampling,
    build_scene,
    render_environment,
    render_mixed,
    render_olat,
)
from appearance.render.environment_maps import studio
from appearance.render.lights import PackedLights
from appearance.scene.backend import ensure_backend
from appearance.scene.hair_scene import SCALE
from reconstruction import Camera, Light, Mesh
from reconstruction.geometry.cameras import facing
from reconstruction.geometry.light_profiles import LightProfile

HAIR = HairAppearance((0.1, 0.2, 0.45), 0.3, 0.3)
BEAM = LightProfile(
    "beam",
    np.array([0.0, 70, 180, 290, 360]),
    np.array([0.0, 20, 45, 100]),
    np.array(
        [
            [1, 0.9, 0.4, 0.1],
            [1, 0.7, 0.3, 0],
            [1, 0.5, 0.2, 0],
            [1, 0.8, 0.1, 0],
            [1, 0.9, 0.4, 0.1],
        ]
    ),
)


def irradiance(light, point, normal, samples=1 << 16):
    """Mean irradiance `(3,)` at `point` on a surface with `normal`, by sampling the light."""
    ensure_backend()
    bank = PackedLights.of([light])
    generator = mi.PCG32(samples, 1)
    p = mi.Point3f((np.asarray(point, float) * SCALE).tolist())
    target, intensity = bank.sample(mi.UInt32(0), p, generator, mi.Bool(True))
    towards = target - p
    squared = dr.squared_norm(towards)
    cosine = dr.dot(towards, mi.Vector3f(np.asarray(normal, float).tolist())) * dr.rsqrt(squared)
    value = intensity * dr.maximum(cosine, 0) / squared
    return np.array(dr.mean(value, axis=1)).ravel()


def test_a_sphere_shines_like_a_point_on_what_faces_it():
    """pi L sin² a, L = I/(pi r²): the radius cancels, up to where the sphere all but touches."""
    position, intensity = np.array([0.3, -0.2, 0.5]), np.array([8.0, 4.0, 2.0])
    d = np.linalg.norm(position)
    for radius in (0.0, 1e-6, 1e-3, 0.05, 0.5):
        light = Light("l", position, intensity, radius=radius)
        found = irradiance(light, (0, 0, 0), position / d)
        np.testing.assert_allclose(found, intensity / d**2, rtol=2e-3 if radius > 0.1 else 1e-4)


def test_the_shadow_ray_ends_on_the_sphere():
    ensure_backend()
    light = Light("l", np.array([0.1, 0.2, 0.3]), np.ones(3), radius=0.04)
    bank = PackedLights.of([light])
    p = mi.Point3f(-0.1 * SCALE, 0, 0)
    target, _ = bank.sample(mi.UInt32(0), p, mi.PCG32(10000, 1), mi.Bool(True))
    away = np.array(target).T / SCALE - light.position
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), 0.04, rtol=1e-4)
    # all of the side that p sees, and no more
    to_centre = light.position + np.array([0.1, 0, 0])
    d = np.linalg.norm(to_centre)
    assert (-away @ to_centre / (0.04 * d)).min() == pytest.approx(0.04 / d, abs=0.01)


@pytest.mark.parametrize("profile", [None, BEAM], ids=["cosine", "profile"])
def test_a_panel_is_the_sum_of_its_points(profile):
    light = Light(
        "panel",
        np.array([0.1, -0.1, 0.4]),
        np.array([8.0, 4.0, 2.0]),
        orientation=facing((0.2, 0.1, -1.0), 25.0),
        profile=profile,
        size=(0.3, 0.2),
    )
    u, v = np.meshgrid((np.arange(64) + 0.5) / 64 - 0.5, (np.arange(64) + 0.5) / 64 - 0.5)
    right, down = light.orientation[:2]
    points = light.position + u[..., None] * 0.3 * right + v[..., None] * 0.2 * down
    d2 = (points**2).sum(-1)
    shares = [
        Light(
            "p", x, light.intensity, orientation=light.orientation, profile=profile, size=(1, 1)
        ).intensity_towards(np.zeros(3))
        for x in points.reshape(-1, 3)
    ]
    each = np.array(shares) * (points[..., 2] / d2**1.5).reshape(-1, 1)
    np.testing.assert_allclose(irradiance(light, (0, 0, 0), (0, 0, 1)), each.mean(0), rtol=5e-3)
    behind = irradiance(light, light.position - 0.2 * light.orientation[2], (0, 0, -1))
    assert not behind.any()


def test_profiles_are_those_of_the_rig():
    """`PackedLights` and `Light.intensity_towards` are two writings of one thing."""
    ensure_backend()
    rng = np.random.default_rng(0)
    kinds = [
        BEAM,
        LightProfile(
            "a", np.array([-60.0, 0, 90]), np.array([0.0, 70, 180]), rng.uniform(size=(3, 3)), "A"
        ),
        LightProfile(
            "b", np.array([-90.0, 0, 90]), np.array([0.0, 70, 180]), rng.uniform(size=(3, 3)), "B"
        ),
        None,
    ]
    lights = [
        Light(
            str(i),
            rng.normal(size=3),
            rng.uniform(size=3),
            orientation=facing(rng.normal(size=3), rng.uniform(0, 360)),
            profile=kinds[i % 4],
        )
        for i in range(8)
    ]
    points = rng.normal(size=(5000, 3)).astype(np.float32)
    which = rng.integers(8, size=5000)
    _, found = PackedLights.of(lights).sample(
        mi.UInt32(which), mi.Point3f((points * SCALE).T), None, mi.Bool(True)
    )
    expected = np.array(
        [lights[i].intensity_towards(p) for i, p in zip(which, points, strict=True)]
    )
    np.testing.assert_allclose(np.array(found).T / SCALE**2, expected, atol=1e-4)


def test_a_sphere_casts_a_soft_shadow(small):
    """Under a half plane's edge: the part of the light's disc that is seen."""
    light_height, edge_height, radius = 2.0, 0.1, 0.1
    floor = small.plane(0.05).vertices
    wall = np.array(
        [[0, -1, edge_height], [1, -1, edge_height], [1, 1, edge_height], [0, 1, edge_height]]
    )
    mesh = Mesh(
        np.concatenate([floor, wall]), np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    )
    scene = build_scene(small.no_hair, mesh, hair=HAIR, skin=(0.5, 0.5, 0.5))
    # seen from under the edge, so that the half plane hides no pixel
    camera = Camera.look_at("c", 32, 4, (-0.02, 0, 0.09), (0, 0, 0), 12, roll_deg=90)
    light = Light("l", np.array([0, 0, light_height]), np.full(3, 8.0), radius=radius)
    point = Light("p", light.position, light.intensity)
    open_scene = build_scene(small.no_hair, small.plane(0.05), hair=HAIR, skin=(0.5, 0.5, 0.5))
    soft = render_mixed(scene, camera, [light], sampling=Sampling(1024, 1))[..., 0]
    lit = render_mixed(open_scene, camera, [point], sampling=Sampling(64, 1))[..., 0]
    column, row = np.meshgrid(np.arange(32), np.arange(4))
    rays = camera.rays(np.stack([column, row], -1))
    x = (camera.center - rays * (camera.center[2] / rays[..., 2])[..., None])[..., 0]
    # where the line from x over the edge meets the light's height, in radii from its middle
    at = np.clip(-x * (light_height - edge_height) / edge_height / radius, -1, 1)
    visible_share = 0.5 + (np.arcsin(at) + at * np.sqrt(1 - at * at)) / np.pi
    assert visible_share.min() < 0.3
    assert visible_share.max() > 0.7
    np.testing.assert_allclose(soft / lit, visible_share, atol=0.03)


@pytest.fixture(scope="module")
def tufted(small):
    return (
        build_scene(small.tuft(100), small.plane(), hair=HAIR),
        small.camera(size=16),
        small.lights(),
    )


def test_a_mixture_is_the_sum_of_its_parts(tufted):
    """Two lights, one of them taken away, and two maps: against each alone, in the mean."""
    scene, camera, lights = tufted
    weights = np.array([[1.0, 0.5, 0.2], [-0.1, -0.1, 0.0], [0.5, 0.5, 0.5]])
    maps = [Environment(studio(16), 30.0, 0.2), Environment(np.ones((4, 8, 3)), 0.0, (0, 0.1, 0.3))]
    alone = render_olat(scene, camera, lights, spp=256, max_depth=5, seed=1).mean((1, 2))
    parts = (alone * weights).sum(0)
    for e in maps:
        image = render_environment(
            scene, camera, e.envmap, Sampling(256, 5, 2), rotation_deg=e.rotation_deg
        )
        parts = parts + image.mean((0, 1)) * np.asarray(e.weight)
    mixed = render_mixed(scene, camera, lights, maps, Sampling(512, 5, 3), weights=weights)
    np.testing.assert_allclose(mixed.mean((0, 1)), parts, rtol=0.03)


def test_a_light_taken_away_from_itself_is_dark(tufted):
    scene, camera, lights = tufted
    twice = [lights[0], lights[0]]
    sampling = Sampling(512, 3, 4)
    none = render_mixed(scene, camera, twice, (), sampling, weights=[[1.0], [-1.0]])
    one = render_mixed(scene, camera, twice[:1], (), sampling)
    assert abs(none.mean()) < 0.03 * one.mean()


def test_mixtures_of_seeds_and_of_nothing(tufted):
    scene, camera, lights = tufted
    a, b, c = (render_mixed(scene, camera, lights, sampling=Sampling(8, seed=s)) for s in (1, 1, 2))
    assert a.tobytes() == b.tobytes() != c.tobytes()
    assert not render_mixed(scene, camera, sampling=Sampling(1)).any()
    with pytest.raises(ValueError, match="must be finite"):
        render_mixed(scene, camera, lights, weights=np.nan)
    with pytest.raises(ValueError, match="must be finite"):
        render_mixed(scene, camera, (), [Environment(studio(16), weight=np.nan)])
    with pytest.raises(ValueError, match="greater than 0"):
        Sampling(0)


@pytest.mark.usefixtures("mitsubas_shadows")
def test_lights_of_every_shape_shine_in_olat_images(tufted):
    """Each light alone, against the mixture of that one light."""
    scene, camera, lights = tufted
    shapes = (
        {"radius": 0.1},
        {"orientation": facing((-0.2, -1.0, -0.2)), "profile": BEAM},
        {"orientation": facing((0.2, -0.1, -1.0)), "size": (0.3, 0.2)},
    )
    lights = [replace(light, **shape) for light, shape in zip(lights, shapes, strict=True)]
    olat = render_olat(scene, camera, lights, spp=256, max_depth=4, seed=1)
    for image, light in zip(olat, lights, strict=True):
        one = render_mixed(scene, camera, [light], sampling=Sampling(256, 4, 2))
        np.testing.assert_allclose(image.mean((0, 1)), one.mean((0, 1)), rtol=0.04)

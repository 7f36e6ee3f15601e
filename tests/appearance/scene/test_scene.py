"""Scenes: curves through the strands' points, materials, and conventions."""

import mitsuba as mi
import numpy as np
import pytest

from appearance import HairAppearance, build_scene, render_olat
from appearance.render.coverage import coverage
from appearance.scene.hair_appearance import DiffuseHair
from appearance.scene.hair_scene import SCALE, _guarded
from reconstruction import Camera, Light, Strands
from reconstruction.array_backend import for_kernels
from reconstruction.geometry.splines import spline_control_points

HAIR = HairAppearance((0.1, 0.2, 0.45), 0.3, 0.3)


def knots(control, segments):
    """Where a uniform cubic B-spline starts and ends its segments."""
    c = control[:, :3]
    start = (c[segments] + 4 * c[segments + 1] + c[segments + 2]) / 6
    end = (c[segments + 1] + 4 * c[segments + 2] + c[segments + 3]) / 6
    return start, end


def test_curves_pass_through_the_points():
    rng = np.random.default_rng(0)
    lengths = [2, 3, 4, 9, 9, 30]
    lines = []
    for n in lengths:
        steps = np.array([0, 0, 1.0]) + 0.3 * rng.normal(size=(n, 3))
        lines.append(np.cumsum(steps / np.linalg.norm(steps, axis=1, keepdims=True), axis=0))
    strands = Strands.from_list(lines, radius=1e-3)
    control, segments = spline_control_points(strands)
    assert control.shape == (sum(lengths) + 2 * len(lengths), 4)
    starts = strands.segment_starts
    start, end = knots(control, segments)
    np.testing.assert_allclose(start, strands.points[starts], atol=2e-6)
    np.testing.assert_allclose(end, strands.points[starts + 1], atol=2e-6)
    assert (control[:, 3] == 1e-3).all()


def test_radii_belong_to_their_points():
    radius = np.array([1, 2, 3, 4, 5], np.float32) * 1e-4
    line = np.array([[0, 0, z] for z in range(5)], np.float32)
    control, _ = spline_control_points(Strands(line, np.array([0, 5]), radius))
    np.testing.assert_allclose(control[:, 3], [*radius[:1], *radius, *radius[-1:]])


def test_only_unevenly_spaced_strands_are_resampled():
    even = np.array([[0, 0, z] for z in (0, 1, 2, 3)], float)
    uneven = np.array([[1, 0, z] for z in (0, 0.1, 0.2, 3)], float)
    control, segments = spline_control_points(Strands.from_list([even, uneven]))
    start, end = knots(control, segments)
    np.testing.assert_allclose(start[:, 2], [0, 1, 2, 0, 1, 2], atol=1e-6)
    np.testing.assert_allclose(end[3:, 2], [1, 2, 3], atol=1e-6)


@pytest.mark.parametrize("radius", [4e-5, 8e-5, 4e-4])
def test_a_ray_through_the_fibre_that_it_starts_on_meets_nothing(radius):
    """Light from behind passes it. By Mitsuba's `ray_test`, OptiX stops up to a third of it."""
    s = np.linspace(-0.5, 0.5, 40)[:, None]
    line = [0.05, -0.08, 0.05] + 0.1 * s * [0.44, 0.87, 0.22] + 0.02 * s**2 * [0.89, -0.45, 0]
    scene = build_scene(Strands.from_list([line], radius), None, hair=HAIR)
    rng = np.random.default_rng(0)
    targets = np.repeat(line[10:30], 1000, axis=0)
    way = rng.normal(size=targets.shape)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    origin = mi.Point3f(for_kernels(SCALE * (targets - way).T))
    si = scene.mi_scene.ray_intersect(mi.Ray3f(origin, mi.Vector3f(for_kernels(way.T))))
    met = np.array(si.is_valid())
    assert met.mean() > 0.99
    behind = si.p - SCALE * si.n
    assert np.array(scene.occluded(si.spawn_ray_to(behind)))[met].mean() < 1e-4
    # and what stands in the way does stop it
    assert np.array(scene.occluded(mi.Ray3f(origin, mi.Vector3f(for_kernels(way.T)))))[met].all()


def test_empty_scenes_render(small):
    camera, lights = small.camera(size=8), small.lights()
    nothing = build_scene(small.no_hair, None, hair=HAIR)
    assert not render_olat(nothing, camera, lights, spp=1).any()
    assert not coverage(nothing, camera)["hair"].any()
    for strands, head in ((small.tuft(20), None), (small.no_hair, small.ball())):
        scene = build_scene(strands, head, hair=HAIR)
        image = render_olat(scene, camera, lights, spp=4)
        assert image.shape == (3, 8, 8, 3)
        assert image.max() > 0
        covered = coverage(scene, camera)
        assert (covered["hair"].sum() > 0) == (len(strands) > 0)
        assert (covered["head"].sum() > 0) == (head is not None)


def test_coverage_of_a_ball_is_its_disc(small):
    camera = small.camera((0.0, -1.0, 0.0), size=64)
    scene = build_scene(small.no_hair, small.ball(), hair=HAIR)
    share = coverage(scene, camera, 16)["head"]
    # the tangent cone's disc on the image plane
    radius = camera.K[0, 0] * np.tan(np.arcsin(0.08))
    assert share.sum() == pytest.approx(np.pi * radius**2, rel=0.01)
    row, column = (np.average(i, weights=share) for i in np.mgrid[:64, :64])
    assert (row, column) == pytest.approx((31.5, 31.5), abs=0.05)


def test_other_materials_share_the_geometry(small):
    camera, lights = small.camera(), small.lights()[:1]
    scene = build_scene(small.tuft(), small.plane(), hair=HAIR)
    dark = scene.with_hair(HairAppearance((3.0, 3.0, 3.0), 0.3, 0.3))
    diffuse = scene.with_hair(DiffuseHair((0.5, 0.25, 0.0)))
    assert dark.mi_scene is scene.mi_scene is diffuse.mi_scene
    hair = coverage(scene, camera)["hair"] == 1
    means = [render_olat(s, camera, lights, spp=16)[0][hair].mean(0) for s in (scene, dark)]
    assert (means[1] < 0.8 * means[0]).all()
    colour = render_olat(diffuse, camera, lights, spp=16, max_depth=1)[0][hair].mean(0)
    # the camera's filter reaches a little past fully covered pixels, onto the floor
    assert colour[1] == pytest.approx(colour[0] / 2, rel=5e-3)
    assert colour[2] < 5e-3 * colour[0]
    skin = scene.with_skin((0.0, 0.5, 1.0))
    floor = coverage(scene, camera)["head"] == 1
    colour = render_olat(skin, camera, lights, spp=4, max_depth=1)[0][floor].mean(0)
    assert colour[0] < 5e-3 * colour[1]
    assert colour[2] == pytest.approx(2 * colour[1], rel=5e-3)


@pytest.mark.parametrize("bsdf", ["extended_hair", pytest.param("hair", marks=pytest.mark.slow)])
def test_a_positive_tilt_moves_the_first_reflection_towards_the_root(bsdf):
    """A vertical fibre, root below, lit level: R goes down by twice the tilt."""
    fibre = Strands(np.array([[0, 0, -0.2], [0, 0, 0.2]], np.float32), np.array([0, 2]), 0.01)
    light = Light("level", np.array([0.0, -20.0, 0.0]), np.array([400.0, 400.0, 400.0]))
    # so dark that only R leaves the fibre
    hair = HairAppearance((50.0, 50.0, 50.0), 0.15, 0.3, tilt_deg=3.0)
    scene = build_scene(fibre, None, hair=hair).with_hair(hair, bsdf=bsdf)
    elevations = np.arange(-20.0, 20.5, 2.0)
    results = []
    for e in np.radians(elevations):
        eye = 4 * np.array([0.0, -np.cos(e), np.sin(e)])
        camera = Camera.look_at("eye", 8, 8, eye, (0, 0, 0), fov_deg=0.05)
        results.append(render_olat(scene, camera, [light], spp=64, max_depth=1).mean())
    peak = np.average(elevations, weights=np.array(results) ** 4)
    assert peak == pytest.approx(-6.0, abs=1.0)


def test_appearance_reads_back_what_it_writes():
    hair = HairAppearance((0.1, 0.2, 0.45), 0.3, 0.25, eta=1.5, tilt_deg=-1.0)
    assert HairAppearance.from_dict(hair.to_dict()) == hair
    with pytest.raises(ValueError, match=r"unknown fields \['beta'\]"):
        HairAppearance.from_dict({**hair.to_dict(), "beta": 1})
    with pytest.raises(ValueError, match=r"\['beta_n'\] are missing"):
        HairAppearance.from_dict({"sigma_a": [0, 0, 0], "beta_m": 0.3})


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("sigma_a", (0.1, -0.1, 0.1)),
        ("sigma_a", (0.1, float("nan"), 0.1)),
        ("sigma_a", (0.1, 0.1)),
        ("beta_m", 0.0),
        ("beta_n", 1.5),
        ("eta", 1.0),
        ("tilt_deg", float("nan")),
    ],
)
def test_appearance_out_of_range_is_named(field, value):
    with pytest.raises(ValueError, match=field):
        HairAppearance(**{"sigma_a": (0, 0, 0), "beta_m": 0.3, "beta_n": 0.3, field: value})


def test_albedos_out_of_range_are_refused(small):
    with pytest.raises(ValueError, match="albedo"):
        DiffuseHair((0.5, 1.5, 0.5))
    with pytest.raises(ValueError, match="skin"):
        build_scene(small.no_hair, small.plane(), hair=HAIR, skin=(0.5, 0.5, 2.0))


def test_the_scene_is_in_centimetres(small):
    scene = build_scene(small.no_hair, small.ball(), hair=HAIR)
    assert scene.mi_scene.bbox().max.z == pytest.approx(0.08 * SCALE, rel=1e-3)


def test_no_hit_reads_past_the_last_segment():
    points = np.array([[0, 0, 0], [0, 0, 0.1]], np.float32)
    control, segments = spline_control_points(Strands(points, np.array([0, 2]), 1e-3))
    guarded, indices = _guarded(control, np.repeat(segments, 2_000_000))
    rounded = np.nextafter(np.float32(1), np.float32(0)) * np.float32(2_000_000)
    assert int(np.ceil(rounded)) < len(indices)
    np.testing.assert_allclose(guarded[indices[-1] :, :3], control[segments[-1] :][:4, :3])
    assert guarded[indices[-1] :, 3].max() < 0.01 * control[:, 3].min()

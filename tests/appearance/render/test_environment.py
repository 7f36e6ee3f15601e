"""Environment maps: absolute radiance, orientation, readers."""

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from appearance import HairAppearance, Sampling, build_scene, render_environment
from appearance.render import environment
from appearance.render.coverage import coverage, covered_pixels
from appearance.render.environment import _along_curve, direct_environment
from appearance.render.environment_maps import load_environment, sky, studio
from appearance.render.paths import Surface, camera_rays
from appearance.render.smoothed import environment_smoothed
from reconstruction import Camera, Strands, write_exr
from reconstruction.array_backend import for_kernels

HAIR = HairAppearance((0.1, 0.2, 0.45), 0.3, 0.3)
ALBEDO = (0.5, 0.25, 0.8)
TILT = np.array([0.01, 0.02, 0.01])  # off the axis, where a map has an edge or a pole


@pytest.fixture(scope="module")
def ball(small):
    return build_scene(small.no_hair, small.ball(), hair=HAIR, skin=ALBEDO)


def eye(direction, size=12, fov_deg=4.0):
    return Camera.look_at("eye", size, size, 1.0 * np.array(direction), (0, 0, 0), fov_deg)


def test_a_convex_body_in_a_uniform_world_shows_its_albedo(ball):
    image = render_environment(ball, eye((0.3, -0.8, 0.2)), np.ones((8, 16, 3)), Sampling(256))
    np.testing.assert_allclose(image.mean((0, 1)), ALBEDO, rtol=0.02)


def test_well_spread_directions_keep_the_mean_and_halve_the_noise(ball):
    # a convex body under a map of two boxes: no shadow, one bounce; noise is between two seeds
    view, spp = eye((0.3, -0.8, 0.2), fov_deg=9.0), 64
    spread, drawn = (
        np.array([render(seed) for seed in (1, 2)])
        for render in (
            lambda seed: direct_environment(ball, view, studio(), spp, seed),
            lambda seed: render_environment(ball, view, studio(), Sampling(spp, 1, seed)),
        )
    )
    assert spread.mean() == pytest.approx(drawn.mean(), rel=0.02)
    assert np.std(spread[0] - spread[1]) < 0.5 * np.std(drawn[0] - drawn[1])
    uniform = direct_environment(ball, eye((0.3, -0.8, 0.2)), np.ones((8, 16, 3)), 256)
    np.testing.assert_allclose(uniform.mean((0, 1)), ALBEDO, rtol=0.02)


@pytest.mark.parametrize("shape", [(8, 8), (5, 12), (1, 3)])
def test_the_curve_through_a_map_visits_each_texel_once_and_moves_to_neighbours(shape):
    order = _along_curve(*shape)
    assert sorted(order) == list(range(shape[0] * shape[1]))
    row, column = np.divmod(order, shape[1])
    steps = np.abs(np.diff(row)) + np.abs(np.diff(column))
    assert np.mean(steps == 1) == (1 if shape == (8, 8) else pytest.approx(1, abs=0.1))


def test_clear_hair_in_a_uniform_world_vanishes(small):
    """White furnace. What is missing is Mitsuba's hair sampler's loss and paths cut short."""
    clear = HairAppearance((0.0, 0.0, 0.0), 0.3, 0.3)
    scene = build_scene(small.tuft(60), None, hair=clear)
    world = np.ones((8, 16, 3))
    image = render_environment(scene, small.camera(), world, Sampling(256, 60), background=True)
    assert image.mean() == pytest.approx(1, abs=0.015)


def test_a_white_sky_is_reflected_in_full_by_clear_hair_in_smoothed_pictures(small):
    """White furnace: direct and indirect light add up to the share of a pixel that hair covers."""
    clear = HairAppearance((0.0, 0.0, 0.0), 0.3, 0.3)
    scene, camera = build_scene(small.tuft(60), None, hair=clear), small.camera(size=32)
    image = environment_smoothed(scene, camera, np.ones((8, 16, 3)), Sampling(128, 60))
    covered = coverage(scene, camera, 1024)["hair"]
    assert image.sum((0, 1)) == pytest.approx(np.full(3, covered.sum()), rel=0.03)


def test_a_chosen_direction_has_less_noise_than_a_drawn_one_and_the_same_mean(small, monkeypatch):
    """Hair scatters few of a map's bright directions towards a camera."""
    scene, camera = build_scene(small.tuft(60), None, hair=HAIR), small.camera(size=16)

    def pictures():
        return np.array([direct_environment(scene, camera, studio(), 256, seed) for seed in (1, 2)])

    chosen = pictures()
    monkeypatch.setattr(environment, "CANDIDATES", 1)
    monkeypatch.setattr(environment._Gather.__init__, "__defaults__", (1,))
    drawn = pictures()
    assert chosen.mean() == pytest.approx(drawn.mean(), rel=0.08)
    assert np.std(chosen[0] - chosen[1]) < 0.6 * np.std(drawn[0] - drawn[1])


@pytest.mark.parametrize(
    ("row", "column", "axis"),
    [
        (0, 0, (0, 0, 1)),
        (7, 0, (0, 0, -1)),
        (4, 8, (1, 0, 0)),
        (4, 0, (-1, 0, 0)),
        (4, 12, (0, -1, 0)),
    ],
    ids=[
        "top row is up",
        "bottom row is down",
        "middle is +x",
        "edge is -x",
        "right of middle is -y",
    ],
)
def test_orientation(ball, row, column, axis):
    """A lit patch of the map lights the side that faces it, and is seen in its direction."""
    world = np.zeros((8, 16, 3))
    if row in (0, 7):
        world[row] = 1
    else:
        world[row - 1 : row + 1, [column - 1, column]] = 1
    axis = np.array(axis, float)
    facing = render_environment(ball, eye(axis + TILT), world, Sampling(64)).mean()
    turned = render_environment(ball, eye(-axis + TILT), world, Sampling(64)).mean()
    assert facing > 0.02
    assert turned < 0.02 * facing
    inside = Camera.look_at("inside", 4, 4, 5 * axis, 6 * axis + TILT, 5)
    assert render_environment(ball, inside, world, Sampling(1), background=True).min() == 1


def test_rotation_turns_the_map_counter_clockwise(ball):
    world = np.zeros((8, 16, 3))
    world[3:5, 7:9] = 1  # towards +x
    lit = {
        axis: render_environment(ball, eye(direction), world, Sampling(32), rotation_deg=90).mean()
        for axis, direction in (("+y", (0.01, 1, 0)), ("+x", (1, 0.01, 0)), ("-y", (0, -1, 0)))
    }
    assert lit["+y"] > 4 * max(lit["+x"], lit["-y"])


def test_a_map_that_has_turned_for_long_is_where_it_is(ball):
    envmap = studio(16)
    camera = eye((0, -1, 0))
    once = render_environment(ball, camera, envmap, Sampling(4), rotation_deg=90)
    often = render_environment(ball, camera, envmap, Sampling(4), rotation_deg=90 + 360 * 1e9)
    np.testing.assert_array_equal(once, often)
    for turn in (np.nan, np.inf):
        with pytest.raises(ValueError, match="rotation_deg must be finite"):
            render_environment(ball, camera, envmap, Sampling(4), rotation_deg=turn)


def test_dark_worlds_are_dark(ball):
    assert not render_environment(ball, eye((0, -1, 0)), np.zeros((4, 8, 3)), Sampling(4)).any()


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -0.1, 1e38])
def test_impossible_radiance_is_refused(ball, value):
    world = np.ones((4, 8, 3))
    world[2, 5, 1] = value
    with pytest.raises(ValueError, match="1 values are not, the first at row 2, column 5"):
        render_environment(ball, eye((0, -1, 0)), world)


def test_maps_of_ones_own():
    for world in (studio(32), sky(32)):
        assert world.shape == (32, 64, 3)
        assert np.isfinite(world).all()
        assert world.min() >= 0
        assert world.max() > 10 * world.mean()
    theta = np.pi * (np.arange(64) + 0.5) / 64
    sun = sky(64, sun_azimuth_deg=30.0, sun_elevation_deg=50.0)
    row, column = np.unravel_index(sun.sum(-1).argmax(), sun.shape[:2])
    assert 90 - np.degrees(theta[row]) == pytest.approx(50, abs=4)
    assert 360 * (0.5 - (column + 0.5) / 128) == pytest.approx(30, abs=4)


def test_reads_radiance_and_openexr(tmp_path):
    world = np.random.default_rng(0).uniform(0.1, 30, (8, 16, 3)).astype(np.float32)
    write_exr(tmp_path / "world.exr", world)
    np.testing.assert_array_equal(load_environment(tmp_path / "world.exr"), world)
    assert cv2.imwrite(str(tmp_path / "world.hdr"), world[..., ::-1])
    shared_exponent = world.max(-1, keepdims=True) / 128
    assert (np.abs(load_environment(tmp_path / "world.hdr") - world) <= shared_exponent).all()


def test_files_that_are_no_maps_are_named(tmp_path):
    with pytest.raises(ValueError, match=r"absent\.hdr: no such environment map"):
        load_environment(tmp_path / "absent.hdr")
    (tmp_path / "text.hdr").write_text("not an image")
    with pytest.raises(ValueError, match=r"text\.hdr: cannot be read"):
        load_environment(tmp_path / "text.hdr")
    (tmp_path / "map.png").touch()
    with pytest.raises(ValueError, match=r"must be \.hdr or \.exr"):
        load_environment(tmp_path / "map.png")
    write_exr(tmp_path / "negative.exr", np.full((4, 8, 3), -1.0))
    with pytest.raises(ValueError, match=r"negative\.exr: radiance must be finite"):
        load_environment(tmp_path / "negative.exr")


@pytest.mark.parametrize("axis", [0, *(pytest.param(a, marks=pytest.mark.slow) for a in (1, 2))])
def test_a_white_fibre_returns_a_white_sky_whichever_way_it_runs(axis):
    """At some 500 hits, over 1,024 directions evenly around: fibres off the middle run along an
    axis but for rounding, where Mitsuba's shading frames are none."""
    points = np.zeros((5, 9, 3))
    points[:, :, axis] = np.linspace(-0.1, 0.1, 9)
    points[:, :, (axis + 1) % 3] = 0.02 * np.arange(-2, 3)[:, None]
    white = HairAppearance((0, 0, 0), 0.5, 0.5, tilt_deg=2)
    scene = build_scene(Strands.from_list(list(points), radius=2e-3), None, hair=white)
    surface, directions = Surface(scene), 1024
    camera = Camera.look_at("cam", 96, 96, (-0.6, -0.5, 0.4), (0, 0, 0), 8)
    covered = covered_pixels(scene, camera)
    lane = dr.arange(mi.UInt32, len(covered) * directions)
    pixel = dr.gather(mi.UInt32, mi.UInt32(for_kernels(covered, np.uint32)), lane // directions)
    row, column = pixel // 96, pixel % 96
    ray = camera_rays(camera, mi.Float(column) + 0.5, mi.Float(row) + 0.5)
    si = surface.interact(ray, mi.Bool(True))
    number = mi.Float(lane % directions)  # a spiral from pole to pole
    z, turn = 1 - (2 * number + 1) / directions, number * float(np.pi * (3 - np.sqrt(5)))
    flat = dr.sqrt(1 - z * z)
    world = mi.Vector3f(flat * dr.cos(turn), flat * dr.sin(turn), z)
    value = surface.eval(si, si.to_local(world), si.is_valid())
    met = np.array(si.is_valid()).reshape(len(covered), directions)[:, 0]
    integral = 4 * np.pi * np.array(value.x).reshape(len(covered), directions)[met].mean(1)
    assert met.sum() > 400
    assert integral == pytest.approx(1, abs=0.01)

"""Rig geometry: cameras, projectors, lights, and the files that describe them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from reconstruction import Camera, Light, Projector, Rig
from reconstruction.geometry.lights import dome_positions
from reconstruction.geometry.rig import RigError

SMALL = """
name = "small"
[dome]
lights = 5
radius = 1.2
intensity = [8.0, 8.0, 8.0]
[[cameras]]
name = "cam_00"
position = [0.0, -0.95, 0.12]
target = [0.0, 0.0, 0.0]
fov_deg = 22.0
width = 160
height = 120
[[cameras]]
name = "cam_01"
position = [0.95, 0.0, 0.12]
target = [0.0, 0.0, 0.0]
fov_deg = 22.0
width = 160
height = 120
[[projectors]]
name = "proj_0"
position = [0.4, -0.9, 0.55]
target = [0.0, 0.0, 0.0]
fov_deg = 20.0
width = 64
height = 64
line_sigma = 0.6
"""
DEMO = Path(__file__).resolve().parents[3] / "stage_service" / "rigs" / "demo.toml"
angles = st.floats(-np.pi, np.pi)
coordinates = st.floats(-3, 3)


def camera(**more: float) -> Camera:
    return Camera.look_at("cam", 160, 120, [0.4, -0.9, 0.3], [0, 0.1, 0], 25.0, **more)


def test_look_at_puts_the_target_in_the_middle_and_up_up():
    one = camera()
    pixel, depth = one.project([0, 0.1, 0])
    np.testing.assert_allclose(pixel, [79.5, 59.5], atol=1e-9)
    assert depth == pytest.approx(np.linalg.norm([0.4, -1.0, 0.3]))
    above, _ = one.project([0, 0.1, 0.05])
    assert above[1] < 59.5
    assert above[0] == pytest.approx(79.5, abs=1e-9)


def test_look_at_field_of_view_is_between_the_outer_pixel_edges():
    one = camera()
    left, right = one.rays([[-0.5, 59.5], [159.5, 59.5]])
    assert np.degrees(np.arccos(left @ right)) == pytest.approx(25.0)


def test_roll_turns_the_camera_clockwise_as_viewed_from_behind():
    # The camera turns clockwise, so the world turns counter-clockwise in its image: up goes left.
    above, _ = camera(roll_deg=90.0).project([0, 0.1, 0.05])
    assert above[0] < 79.5
    assert above[1] == pytest.approx(59.5, abs=1e-9)


@given(st.floats(0, 159), st.floats(0, 119))
def test_rays_and_project_are_inverse(x, y):
    one = camera(roll_deg=17.0)
    ray = one.rays([x, y])
    assert np.linalg.norm(ray) == pytest.approx(1.0)
    pixel, depth = one.project(one.center + 0.7 * ray)
    np.testing.assert_allclose(pixel, [x, y], atol=1e-8)
    assert depth > 0


@given(st.tuples(angles, angles, angles), st.tuples(*[st.floats(-0.1, 0.1)] * 3), coordinates)
def test_a_moved_camera_sees_the_unmoved_subject_alike(euler, shift, z):
    Q = Rotation.from_euler("xyz", euler).as_matrix()
    point = np.array([0.05, -0.02, 0.01 * z])
    one, light = camera(), Light("lamp", np.array([0.3, 1.0, 0.2]), np.ones(3))
    expected, depth = one.project(Q @ point + shift)
    pixel, moved_depth = one.moved(Q, shift).project(point)
    np.testing.assert_allclose(moved_depth, depth, atol=1e-12)
    np.testing.assert_allclose(pixel, expected, atol=1e-7)
    distance = np.linalg.norm(light.position - (Q @ point + shift))
    moved = light.moved(Q, shift).position
    assert np.linalg.norm(moved - point) == pytest.approx(distance)


def projector() -> Projector:
    return Projector.look_at(
        "beam", 64, 48, [0.5, 0.9, 0.6], [0, 0, 0], 20.0, roll_deg=45.0, intensity=[1, 2, 3]
    )


@given(st.floats(0, 47), st.floats(0, 63), st.floats(0.1, 3))
def test_a_row_s_plane_holds_the_row_s_rays(row, column, distance):
    one = projector()
    plane = one.plane(row)
    assert np.linalg.norm(plane[:3]) == pytest.approx(1.0)
    point = one.center + distance * one.rays([column, row])
    assert plane[:3] @ point + plane[3] == pytest.approx(0.0, abs=1e-12)


def test_planes_grow_with_the_row_on_their_positive_side():
    one = projector()
    plane = one.plane(20.0)
    below = one.center + one.rays([30, 21])
    assert plane[:3] @ below + plane[3] > 0


def test_the_rows_of_a_sweep_sum_to_the_all_on_picture():
    one = projector()
    rows = np.arange(-10, 70)
    for v in (0.0, 11.3, 47.0):
        assert one.row_weight(rows, v).sum() == pytest.approx(1.0, abs=1e-12)
    assert one.row_weight(20, 20.0) > one.row_weight(20, 20.7) > one.row_weight(20, 23.0)


def test_dome_lamps_are_evenly_spread_down_to_the_lowest():
    positions = dome_positions(331, 1.2, -50.0)
    np.testing.assert_allclose(np.linalg.norm(positions, axis=1), 1.2)
    lowest = np.degrees(np.arcsin(positions[:, 2].min() / 1.2))
    assert -50.0 < lowest < -48.0
    gaps = np.linalg.norm(positions[:, None] - positions[None], axis=-1)
    nearest = np.sort(gaps, axis=1)[:, 1]
    assert nearest.max() / nearest.min() < 1.8


def test_the_lamp_beside_a_camera_is_above_it():
    rig = Rig.load(DEMO)
    for light in rig.lights:
        if light.beside is not None:
            one = rig.camera(light.beside)
            assert np.linalg.norm(light.position - one.center) == pytest.approx(0.05)
            assert light.position[2] > one.center[2]
    assert sum(light.beside is not None for light in rig.lights) == len(rig.cameras)


def test_a_rig_reads_back_exactly_from_json(tmp_path):
    rig = Rig.load(DEMO)
    path = tmp_path / "rig.json"
    path.write_text(json.dumps(rig.to_dict()))
    again = Rig.load(path)
    assert again.to_dict() == rig.to_dict()
    with pytest.raises(KeyError, match="no light 'x'"):
        rig.light("x")


@pytest.mark.parametrize(
    ("old", "new", "names"),
    [
        ("fov_deg = 22.0\n", "", "[[cameras]] number 1 (cam_00): the field 'fov_deg' is missing"),
        ("width = 160", "wide = 160\nwidth = 160", "unknown fields ['wide']"),
        ("width = 160", "width = 0", "size must be positive"),
        ('name = "cam_01"', 'name = "cam_00"', "cameras must have distinct names"),
        ("line_sigma = 0.6", "line_sigma = 0.0", "line_sigma must be positive"),
        ("radius = 1.2", "", "[dome]: the field 'radius' is missing"),
        ("position = [0.0, -0.95, 0.12]", "position = [0.0, 0.0, 0.0]", "position and target"),
        ("[dome]", "[dome", "small.toml"),
    ],
)
def test_errors_name_file_table_and_field(tmp_path, old, new, names):
    assert old in SMALL
    path = tmp_path / "small.toml"
    path.write_text(SMALL.replace(old, new, 1))
    with pytest.raises(RigError) as error:
        Rig.load(path)
    assert str(path) in str(error.value)
    assert names in str(error.value)


def test_a_light_whose_rows_are_right_up_forward_is_refused():
    """Its profile would shine upside down: rows are right, down, forward, as of cameras."""
    right, down, forward = np.eye(3)
    Light("spot", (0, 0, 1), (1, 1, 1), orientation=np.array([right, down, forward]))
    with pytest.raises(ValueError, match=r"spot: orientation must be a rotation .* no mirror"):
        Light("spot", (0, 0, 1), (1, 1, 1), orientation=np.array([right, -down, forward]))


def test_a_rig_without_cameras_is_refused(tmp_path):
    path = tmp_path / "rig.json"
    path.write_text("{}")
    with pytest.raises(RigError, match=r"at least one \[\[cameras\]\] table"):
        Rig.load(path)
    with pytest.raises(RigError, match="no such rig file"):
        Rig.load(tmp_path / "none.toml")


def test_the_domes_radius_is_not_that_of_its_lamps(tmp_path):
    for name in ("demo", "stage331"):
        rig = Rig.load(DEMO.with_name(f"{name}.toml"))
        assert {light.radius for light in rig.lights} == {0.0}
    (tmp_path / "rig.toml").write_text(
        "[dome]\nlights = 5\nradius = 1.2\nlight_radius = 0.02\nintensity = [1.0, 1.0, 1.0]\n"
        '[[cameras]]\nname = "c"\nposition = [0, -1, 0]\ntarget = [0, 0, 0]\nfov_deg = 20\n'
        "width = 8\nheight = 8\n"
    )
    lights = Rig.load(tmp_path / "rig.toml").lights
    assert {light.radius for light in lights} == {0.02}
    np.testing.assert_allclose([np.linalg.norm(x.position) for x in lights], 1.2)
    text = (tmp_path / "rig.toml").read_text()
    (tmp_path / "rig.toml").write_text(text.replace("light_radius", "lamp_size"))
    with pytest.raises(RigError, match=r"\[dome\]: unknown fields \['lamp_size'\]"):
        Rig.load(tmp_path / "rig.toml")

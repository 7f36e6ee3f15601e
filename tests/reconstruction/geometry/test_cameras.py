"""Pinholes, projectors, lights and the rig that holds them."""

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

RIGS = Path(__file__).resolve().parents[3] / "stage_service" / "rigs"
number = st.floats(-1, 1)


@st.composite
def cameras(draw: st.DrawFn) -> Camera:
    vector = np.array([draw(number) for _ in range(3)])
    R = Rotation.from_rotvec(3 * vector).as_matrix()
    K = [[draw(st.floats(50, 900)), draw(number), 40], [0, draw(st.floats(50, 900)), 30], [0, 0, 1]]
    return Camera("c", 80, 60, np.array(K), R, np.array([draw(number) for _ in range(3)]))


@given(camera=cameras(), x=st.floats(-0.49, 79), y=st.floats(-0.49, 59), depth=st.floats(0.05, 20))
def test_rays_and_projection_are_inverse(camera: Camera, x: float, y: float, depth: float) -> None:
    ray = camera.rays([x, y])
    assert np.linalg.norm(ray) == pytest.approx(1)
    pixel, z = camera.project(camera.center + depth * ray)
    np.testing.assert_allclose(pixel, [x, y], atol=1e-8)
    assert z == pytest.approx(depth * (camera.R[2] @ ray))
    assert camera.inside(pixel)


@given(camera=cameras(), turn=st.tuples(number, number, number), point=st.tuples(*[number] * 3))
def test_moving_the_subject_or_the_camera(
    camera: Camera, turn: tuple[float, ...], point: tuple[float, ...]
) -> None:
    Q, d = Rotation.from_rotvec(turn).as_matrix(), np.array([0.3, -0.1, 0.2])
    there, depth = camera.project(Q @ np.array(point) + d)
    here, same_depth = camera.moved(Q, d).project(point)
    assert same_depth == pytest.approx(depth, abs=1e-12)
    if abs(depth) > 1e-3:
        np.testing.assert_allclose(here, there, rtol=1e-7, atol=1e-6)


def test_look_at() -> None:
    camera = Camera.look_at("c", 100, 50, [0, -2, 0], [0, 0, 0], 60)
    np.testing.assert_allclose(camera.center, [0, -2, 0], atol=1e-12)
    pixel, depth = camera.project([0, 0, 0])
    np.testing.assert_allclose(pixel, [49.5, 24.5])
    assert depth == pytest.approx(2)
    right, _ = camera.project([0.1, 0, 0])
    up, _ = camera.project([0, 0, 0.1])
    assert right[0] > 49.5
    assert up[1] < 24.5
    edge = camera.rays([99.5, 24.5])
    assert np.degrees(np.arccos(edge @ [0, 1, 0])) == pytest.approx(30)


def test_roll_turns_the_device_clockwise() -> None:
    """A camera turned clockwise sees what is up turn counter-clockwise: towards image left."""
    camera = Camera.look_at("c", 100, 100, [0, -2, 0], [0, 0, 0], 60, roll_deg=90)
    up, _ = camera.project([0, 0, 0.1])
    assert up[0] < 49.5 - 1
    assert up[1] == pytest.approx(49.5)


@pytest.mark.parametrize(("eye", "target"), [([0, 0, 2], [0, 0, 0]), ([0, 0, -2], [0, 0, 0])])
def test_look_straight_up_or_down(eye: list[float], target: list[float]) -> None:
    camera = Camera.look_at("c", 64, 64, eye, target, 40)
    np.testing.assert_allclose(camera.R @ camera.R.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(camera.project(target)[0], [31.5, 31.5])


def test_points_behind_the_camera_have_negative_depth() -> None:
    camera = Camera.look_at("c", 64, 64, [0, -1, 0], [0, 0, 0], 40)
    pixels, depth = camera.project([[0, -2, 0], [0.1, -1, 0]])
    assert depth[0] == pytest.approx(-1)
    assert depth[1] == pytest.approx(0, abs=1e-12)
    assert pixels.shape == (2, 2)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"K": np.eye(2)}, r"c: K must be \(3, 3\)"),
        ({"t": np.array([0, np.nan, 0])}, "c: t must be"),
        ({"R": 2 * np.eye(3)}, "c: R is not a rotation"),
        ({"R": np.diag([1, 1, -1])}, "c: R is not a rotation"),
        ({"K": np.diag([-1, 1, 1])}, "focal lengths must be positive"),
        ({"width": 0}, "size must be positive"),
    ],
)
def test_bad_cameras(change: dict[str, object], words: str) -> None:
    good = {"width": 4, "height": 4, "K": np.eye(3), "R": np.eye(3), "t": np.zeros(3)}
    with pytest.raises(ValueError, match=words):
        Camera("c", **{**good, **change})  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="c: position and target coincide"):
        Camera.look_at("c", 4, 4, [1, 1, 1], [1, 1, 1], 30)


def test_a_row_is_a_plane() -> None:
    projector = Projector.look_at("p", 128, 64, [1, -1, 0.2], [0, 0, 0], 20, roll_deg=30)
    rows = np.array([3.0, 40.5])
    for row, plane in zip(rows, projector.plane(rows), strict=True):
        points = projector.center + 0.9 * projector.rays([[0, row], [77, row], [127, row]])
        np.testing.assert_allclose(points @ plane[:3] + plane[3], 0, atol=1e-12)
        assert np.linalg.norm(plane[:3]) == pytest.approx(1)
        below = projector.center + projector.rays([50, row + 1])
        assert below @ plane[:3] + plane[3] > 0


@given(v=st.floats(3, 60))
def test_a_sweeps_rows_sum_to_all_on(v: float) -> None:
    projector = Projector.look_at("p", 128, 64, [0, -1, 0], [0, 0, 0], 20)
    weight = projector.row_weight(np.arange(64), v)
    assert weight.sum() == pytest.approx(1, abs=1e-6)
    assert abs(int(weight.argmax()) - v) <= 0.5 + 1e-9


@given(
    count=st.integers(1, 500), radius=st.floats(0.1, 5), lowest=st.floats(-90, 80, allow_nan=False)
)
def test_dome_positions_lie_on_the_dome(count: int, radius: float, lowest: float) -> None:
    p = dome_positions(count, radius, lowest)
    assert p.shape == (count, 3)
    np.testing.assert_allclose(np.linalg.norm(p, axis=1), radius, rtol=1e-9)
    assert p[:, 2].min() >= radius * np.sin(np.radians(lowest)) - 1e-9


def test_dome_positions_are_even() -> None:
    p = dome_positions(331, 1.0)
    distance = np.linalg.norm(p[:, None] - p, axis=2) + 10 * np.eye(331)
    even = np.sqrt(4 * np.pi / 331 * 2 / np.sqrt(3))  # a hexagonal lattice of as many points
    assert distance.min() > 0.8 * even
    assert distance.min(axis=1).max() < 1.1 * even
    assert np.linalg.norm(p.mean(axis=0)) < 0.01
    for bad in ((0, 1.0, 0.0), (5, 0.0, 0.0), (5, 1.0, 90.0)):
        with pytest.raises(ValueError, match="a dome needs"):
            dome_positions(*bad)


@pytest.mark.parametrize(
    ("position", "intensity", "words"),
    [([1, 2], [1, 1, 1], "position must be 3"), ([1, 2, 3], [1, -1, 1], "not be negative")],
)
def test_bad_lights(position: list[float], intensity: list[float], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Light("l", np.array(position), np.array(intensity))


RIG = """
name = "small"
[[cameras]]
name = "a"
width = 8
height = 6
position = [0, -1, 0]
target = [0, 0, 0]
fov_deg = 30
[[projectors]]
name = "p"
width = 16
height = 8
position = [1, 0, 0]
target = [0, 0, 0]
fov_deg = 30
intensity = [2, 2, 2]
[dome]
lights = 20
radius = 1.0
intensity = [3, 3, 3]
beside_cameras_at = 0.05
"""


def test_a_rig_is_read_and_read_back(tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text(RIG)
    rig = Rig.load(tmp_path / "rig.toml")
    assert len(rig.lights) == 20
    beside = [light for light in rig.lights if light.beside == "a"]
    assert len(beside) == 1
    assert np.linalg.norm(beside[0].position - rig.camera("a").center) == pytest.approx(0.05)
    assert beside[0].position[2] > rig.camera("a").center[2]
    (tmp_path / "rig.json").write_text(json.dumps(rig.to_dict()))
    again = Rig.load(tmp_path / "rig.json")
    assert again.to_dict() == rig.to_dict()
    assert again.projector("p").intensity.tolist() == [2, 2, 2]
    said = "no light 'x' in this rig; its 20 are light_000, light_001, light_002, …, light_017, "
    with pytest.raises(KeyError, match=said):
        rig.light("x")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("fov_deg = 30\n[[proj", "[[proj", r"\[\[cameras\]\] number 1 \(a\): the field 'fov_deg'"),
        ("width = 8", "width = 8\nwidht = 9", "unknown fields .*widht"),
        ('name = "p"', 'name = "p"\nline_sigma = 0', "line_sigma must be positive"),
        ("radius = 1.0\n", "", r"\[dome\]: the field 'radius'"),
        ("[[cameras]]", "[[camera]]", r"at least one \[\[cameras\]\]"),
        ('name = "small"', "name = ", "rig.toml: "),
    ],
)
def test_bad_rigs_name_file_and_field(tmp_path: Path, old: str, new: str, words: str) -> None:
    assert old in RIG
    (tmp_path / "rig.toml").write_text(RIG.replace(old, new, 1))
    with pytest.raises(RigError, match=rf"rig\.toml: .*{words}|{words}"):
        Rig.load(tmp_path / "rig.toml")
    with pytest.raises(RigError, match="no such rig file"):
        Rig.load(tmp_path / "other.toml")


def test_names_must_be_distinct() -> None:
    camera = Camera.look_at("c", 8, 8, [0, -1, 0], [0, 0, 0], 30)
    with pytest.raises(RigError, match=r"cameras must have distinct names, twice: .*c"):
        Rig("r", (camera, camera), ())


def test_a_light_whose_rows_are_right_up_forward_is_refused() -> None:
    """Its profile would shine upside down: rows are right, down, forward, as of cameras."""
    right, down, forward = np.eye(3)
    Light("spot", (0, 0, 1), (1, 1, 1), orientation=np.array([right, down, forward]))
    with pytest.raises(ValueError, match=r"spot: orientation must be a rotation .* no mirror"):
        Light("spot", (0, 0, 1), (1, 1, 1), orientation=np.array([right, -down, forward]))


def test_the_domes_radius_is_not_that_of_its_lamps(tmp_path: Path) -> None:
    for name in ("demo", "stage331"):
        rig = Rig.load(RIGS / f"{name}.toml")
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

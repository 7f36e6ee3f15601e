"""Cameras from boards: against the truth, and where boards say too little."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from reconstruction import Camera, Rig
from reconstruction.calibration.boards import Board, CalibrationError, Sighting
from reconstruction.calibration.rig_comparison import compare_rigs
from reconstruction.calibration.solve_cameras import calibrate_cameras
from reconstruction.geometry.cameras import facing
from simulators.subject.props import BoardProp, board_pose

Sightings = dict[str, dict[str, Sighting]]


def exact(camera: Camera, prop: BoardProp, noise: float = 0.03, seed: int = 0) -> Sighting:
    """All corners where the camera's model puts them, and a little noise."""
    world = prop.board.corners @ prop.rotation.T + prop.translation
    pixels, _ = camera.project(world)
    rng = np.random.default_rng(seed)
    observed = camera.inside(pixels)
    pixels = pixels + noise * rng.standard_normal(pixels.shape)
    return Sighting(np.flatnonzero(observed), pixels[observed])


def level_board(board: Board, shift: NDArray[np.float64]) -> BoardProp:
    """The board across the line of sight of a camera on the x axis."""
    rotation = facing((-1.0, 0, 0)).T
    return BoardProp(board, rotation, shift - rotation @ np.append(board.size / 2, 0))


def test_corners_are_found_to_a_tenth_of_a_pixel(
    true_rig: Rig, board: Board, noisy_sightings: Sightings
) -> None:
    off = []
    for camera in true_rig.cameras:
        for pose, sighting in noisy_sightings[camera.name].items():
            prop = board_pose(int(pose.split()[1]), board)
            true, _ = camera.project(board.corners @ prop.rotation.T + prop.translation)
            off.append(np.linalg.norm(sighting.pixels - true[sighting.ids], axis=1))
    every = np.concatenate(off)
    assert len(every) > 400
    assert np.sqrt((every**2).mean()) < 0.1
    assert np.percentile(every, 99) < 0.3


def test_cameras_are_found_from_noisy_pictures(
    true_rig: Rig, nominal_rig: Rig, board: Board, noisy_sightings: Sightings
) -> None:
    found = calibrate_cameras(nominal_rig.cameras, board, noisy_sightings)
    errors = compare_rigs(Rig("found", found.cameras, ()), replace(true_rig, lights=()))
    assert max(found.rms.values()) < 0.3
    for name, error in errors["cameras"].items():
        assert error["reprojection_px"][0] < 0.2, name
        assert error["centre_mm"] < 2.0, name
        assert error["turn_deg"] < 0.15, name
        assert error["centre_mm"] < 1e3 * 4 * max(found.position_deviation.values()), name


def test_a_lens_gets_the_numbers_that_it_needs_and_no_more(
    nominal_rig: Rig, board: Board, noisy_sightings: Sightings
) -> None:
    found = calibrate_cameras(nominal_rig.cameras, board, noisy_sightings)
    straight, bent, _ = found.cameras
    assert not straight.distorted
    assert bent.distortion[0] == pytest.approx(-0.25, abs=0.05)


def test_a_camera_that_does_not_see_the_board_is_named(
    nominal_rig: Rig, board: Board, noisy_sightings: Sightings
) -> None:
    blind = {**noisy_sightings, "cam_1": {}}
    with pytest.raises(CalibrationError, match=r"cam_1: .* visible in 0 captures"):
        calibrate_cameras(nominal_rig.cameras, board, blind)


def test_one_pose_leaves_lenses_open_but_places_cameras_whose_lens_is_kept(
    true_rig: Rig, board: Board
) -> None:
    prop = board_pose(0, board)
    one = {c.name: {"only": exact(c, prop, seed=k)} for k, c in enumerate(true_rig.cameras)}
    with pytest.raises(CalibrationError, match=r"in 1 captures, expected 3"):
        calibrate_cameras(true_rig.cameras, board, one)
    found = calibrate_cameras(true_rig.cameras, board, one, keep_lens=True)
    errors = compare_rigs(Rig("found", found.cameras, ()), replace(true_rig, lights=()))
    assert all(e["centre_mm"] < 3 for e in errors["cameras"].values())
    assert all(
        np.array_equal(a.K, b.K) for a, b in zip(found.cameras, true_rig.cameras, strict=True)
    )


def test_a_kept_lens_keeps_its_skew(board: Board) -> None:
    K = np.array([[900.0, 60, 320], [0, 880, 240], [0, 0, 1]])
    camera = Camera("front", 640, 480, K, np.eye(3), np.array([0, 0, 0.9]), (-0.2, 0, 0, 0, 0))
    turn = cv2.Rodrigues(np.array([0.4, -0.3, 0.2]))[0]
    points = (board.corners - (*board.size / 2, 0)) @ turn.T
    observed = {"only": Sighting(np.arange(len(points)), camera.project(points)[0])}
    found = calibrate_cameras([camera], board, {"front": observed}, keep_lens=True)
    np.testing.assert_array_equal(found.cameras[0].K, K)
    to_world = found.board_to_world["only"]
    again, _ = found.cameras[0].project(to_world(board.corners))
    np.testing.assert_allclose(again, observed["only"].pixels, atol=1e-9)
    np.testing.assert_allclose(found.cameras[0].R @ to_world.rotation, turn, atol=1e-9)


def test_parallel_poses_leave_the_lens_open(board: Board) -> None:
    camera = Camera.look_at("front", 320, 256, (0.95, 0, 0), (0, 0, 0), 24.0)
    shifts = np.random.default_rng(2).uniform(-0.04, 0.04, (4, 3)) * (0, 1, 1)
    observed = {f"{k}": exact(camera, level_board(board, s), seed=k) for k, s in enumerate(shifts)}
    with pytest.raises(CalibrationError, match="front: 4 poses of the board do not determine"):
        calibrate_cameras([camera], board, {"front": observed})


@pytest.mark.parametrize("way", [(0, 0, 0), (0.02, 0, 0), (0, 0, 0.1)], ids=["same", "side", "far"])
def test_parallel_poses_raise_an_error_for_the_focal_length(
    board: Board, way: tuple[float, float, float]
) -> None:
    K = np.array([[900.0, 0, 320], [0, 900, 240], [0, 0, 1]])
    camera = Camera("front", 640, 480, K, np.eye(3), np.array([0, 0, 0.6]))
    flat = board.corners - (*board.size / 2, 0)
    observed = {
        f"{k}": Sighting(np.arange(len(flat)), camera.project(flat + k * np.array(way))[0])
        for k in range(3)
    }
    with pytest.raises(CalibrationError, match="focal length is not determined: tilt"):
        calibrate_cameras([camera], board, {"front": observed})


def test_groups_of_cameras_without_a_common_pose_are_named(board: Board) -> None:
    front = Camera.look_at("front", 320, 256, (0.95, 0, 0), (0, 0, 0), 24.0)
    back = Camera.look_at("back", 320, 256, (-0.95, 0, 0), (0, 0, 0), 24.0)
    observed = {
        "front": {f"f{n}": exact(front, board_pose(n, board), seed=n) for n in (0, 1, 15, 16, 17)},
        "back": {f"b{n}": exact(back, board_pose(n, board), seed=n) for n in (7, 8, 9, 23, 24)},
    }
    with pytest.raises(CalibrationError, match=r"connects \['back'\] to \['front'\]"):
        calibrate_cameras([front, back], board, observed)


def test_a_camera_listed_twice_is_found_twice_in_one_place(board: Board) -> None:
    one = Camera.look_at("one", 320, 256, (0.95, 0, 0), (0, 0, 0), 24.0)
    two = replace(one, name="two")
    observed = {f"{n}": exact(one, board_pose(n, board), seed=n) for n in (0, 1, 15, 16, 17, 31)}
    found = calibrate_cameras([one, two], board, {"one": observed, "two": observed})
    assert np.linalg.norm(found.cameras[0].center - found.cameras[1].center) < 1e-5


def test_noise_and_darkness_show_no_board(board: Board) -> None:
    rng = np.random.default_rng(0)
    assert len(board.find(rng.standard_normal((120, 160)))) == 0
    assert len(board.find(np.zeros((120, 160)))) == 0


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"dictionary": "DICT_9X9"}, "no dictionary"),
        ({"marker": 0.03}, "markers smaller than squares"),
        ({"marker": 1e-300}, "a tenth of them"),
        ({"square": 1e-300, "marker": 8e-301}, "1e-6 to 1e3 m"),
        ({"square": float("nan")}, "1e-6 to 1e3 m"),
        ({"columns": 30, "rows": 30}, "has 50"),
    ],
)
def test_an_impossible_board_is_refused(changes: dict[str, object], said: str) -> None:
    with pytest.raises(CalibrationError, match=said):
        Board(**changes)  # type: ignore[arg-type]

"""Projectors from the rows that boards in several poses decode."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from reconstruction import Capture, Projector, Rig
from reconstruction.calibration.boards import Board, CalibrationError
from reconstruction.calibration.solve_cameras import CameraSolution
from reconstruction.calibration.solve_projectors import (
    DecodedRows,
    calibrate_projector,
    projector_intensities,
    rows_on_board,
)
from reconstruction.geometry.rigid_motion import Rigid
from simulators.subject.props import board_pose

POSES = (0, 1, 16, 17, 14, 15)


def decoded(
    projector: Projector, poses: tuple[int, ...], board: Board, noise: float
) -> DecodedRows:
    """Rows of points all over the board, with noise."""
    rng = np.random.default_rng(4)
    flat = np.append(rng.uniform(0, 1, (600, 2)) * board.size, np.zeros((600, 1)), axis=1)
    props = [board_pose(n, board) for n in poses]
    points = np.concatenate([flat @ p.rotation.T + p.translation for p in props])
    row = projector.project(points)[0][:, 1] + noise * rng.standard_normal(len(points))
    return DecodedRows(points, row, np.full(len(points), max(noise, 1e-3)))


def worst_plane(ours: Projector, true: Projector) -> float:
    """Metres that a row's plane misses points of the head by, which the true plane holds."""
    points = 0.1 * np.random.default_rng(0).uniform(-1, 1, (300, 3))
    plane = ours.plane(true.project(points)[0][:, 1])
    return float(np.abs((plane[:, :3] * points).sum(axis=1) + plane[:, 3]).max())


def test_planes_of_light_are_found_though_the_centre_is_not(
    true_rig: Rig, nominal_rig: Rig, board: Board
) -> None:
    true, nominal = true_rig.projectors[0], nominal_rig.projectors[0]
    found = calibrate_projector(nominal, decoded(true, POSES, board, 0.05))
    assert worst_plane(nominal, true) > 5e-3
    assert worst_plane(found.projector, true) < 1e-3
    across = true.R @ (found.projector.center - true.center)
    assert np.hypot(across[1], across[2]) < 3 * found.axis_deviation
    assert found.projector.K[1, 1] == pytest.approx(true.K[1, 1], rel=2e-2)
    # what rows leave open is as it was
    assert found.projector.K[0, 0] == nominal.K[0, 0]
    along = found.projector.R[0] @ (found.projector.center - nominal.center)
    assert along == pytest.approx(0, abs=1e-12)


def test_the_start_may_be_far_off(true_rig: Rig, nominal_rig: Rig, board: Board) -> None:
    true = true_rig.projectors[0]
    far = Projector.look_at("beam", 24, 24, (0.6, -0.5, -0.1), (0.1, 0, 0), 30.0, 60.0)
    found = calibrate_projector(far, decoded(true, POSES, board, 0.05))
    assert worst_plane(found.projector, true) < 1e-3


def test_a_board_in_one_plane_leaves_the_planes_of_light_open(
    true_rig: Rig, nominal_rig: Rig, board: Board
) -> None:
    rows = decoded(true_rig.projectors[0], (0,), board, 0.1)
    with pytest.raises(
        CalibrationError, match=r"projector beam: .* at several distances and tilts"
    ):
        calibrate_projector(nominal_rig.projectors[0], rows)


def test_a_board_without_light_is_an_error(nominal_rig: Rig) -> None:
    with pytest.raises(CalibrationError, match="projector beam: 0 points were decoded"):
        calibrate_projector(nominal_rig.projectors[0], DecodedRows.join([]))


@pytest.mark.slow  # test_solve has it for a whole rig
def test_rows_decoded_from_frames_give_planes_and_intensity(
    true_rig: Rig, nominal_rig: Rig, board: Board, board_captures: list[Capture]
) -> None:
    props = [board_pose(n, board) for n in (0, 1)]
    to_world = {f"{k}": Rigid(p.rotation, p.translation) for k, p in enumerate(props)}
    captures = {f"{k}": c for k, c in enumerate(board_captures[:2])}
    parts = [
        rows_on_board(capture, camera, "beam", board, to_world[k])
        for k, capture in captures.items()
        for camera in true_rig.cameras[:2]
    ]
    found = calibrate_projector(nominal_rig.projectors[0], DecodedRows.join(parts))
    assert found.rms < 0.15
    assert worst_plane(found.projector, true_rig.projectors[0]) < 1e-3
    known = CameraSolution(true_rig.cameras, to_world, {}, {}, {}, {}, {})
    beam = replace(found.projector, intensity=np.ones(3))
    values = projector_intensities([beam], captures, known, board, white=0.8)
    assert values["beam"] == pytest.approx([20.0, 21.0, 19.0], rel=0.02)

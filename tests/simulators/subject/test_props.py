"""Boards and spheres in front of the simulated cameras."""

from __future__ import annotations

import numpy as np
import pytest

from reconstruction import Camera, Light, Projector, Rig
from reconstruction.calibration.boards import Board
from simulators.subject.props import BoardProp, PropResponder, SphereProp, board_pose, named_prop

CAMERA = Camera.look_at("front", 64, 48, (0.9, 0.1, 0.1), (0, 0, 0), 20.0)
LAMPS = (Light("side", (0.6, 0.9, 0.3), (8, 8, 8)), Light("behind", (-1.2, 0, 0), (8, 8, 8)))
BEAM = Projector.look_at("beam", 12, 12, (1.0, -0.2, 0.2), (0, 0, 0), 20.0)
RIG = Rig("props", (CAMERA,), LAMPS, (BEAM,))


@pytest.mark.parametrize(("name", "mirror"), [("mirror:1", True), ("diffuse:0", False)])
def test_spheres_have_names(name: str, mirror: bool) -> None:
    sphere, again = named_prop(name), named_prop(f"{name[:-1]}{int(name[-1]) + 4}")
    assert isinstance(sphere, SphereProp)
    assert sphere.mirror == mirror
    assert np.linalg.norm(sphere.centre) == pytest.approx(0.1118 if mirror else 0.02, abs=1e-4)
    assert isinstance(again, SphereProp)
    assert (again.centre == sphere.centre).all(), "there are four places"


def test_a_boards_number_is_a_sixteenth_turn_about_the_stage() -> None:
    for number in range(16):
        board = named_prop(f"board:{number}")
        assert isinstance(board, BoardProp)
        x, y, _ = board.rotation[:, 2]  # away from where the board faces
        off = np.degrees(np.arctan2(-y, -x)) - 22.5 * number
        assert abs((off + 180) % 360 - 180) < 8


def test_a_diffuse_sphere_shines_by_lambert_and_inverse_square() -> None:
    sphere = SphereProp(np.zeros(3), 0.05, 0.6)
    response = PropResponder(RIG, sphere).lights("front")
    middle = np.rint(CAMERA.project(np.zeros(3))[0]).astype(int)
    at = int(np.flatnonzero(response.pixels == middle[1] * 64 + middle[0])[0])
    ray = CAMERA.rays(middle.astype(float))
    b = -(ray @ CAMERA.center)
    point = CAMERA.center + ray * (b - np.sqrt(b * b - CAMERA.center @ CAMERA.center + 0.05**2))
    v = LAMPS[0].position - point
    expected = 0.6 / np.pi * 8 * (point / 0.05 @ v) / np.linalg.norm(v) ** 3
    assert response.images[0, at] == pytest.approx(expected, rel=2e-3)
    assert not response.images[1].any()  # the lamp behind it


def test_rows_of_a_sweep_sum_to_the_beam_on_the_board() -> None:
    prop = board_pose(0, Board())
    sweep = PropResponder(RIG, prop).sweep("front", 0)["beam"]
    points = prop.sample(CAMERA, np.zeros((1, 2)))
    row = BEAM.project(points.points[:, 0])[0][:, 1]
    brightest = sweep.images.sum(axis=-1).argmax(axis=0)
    shared = np.isin(sweep.pixels, points.pixels)
    index = np.searchsorted(points.pixels, sweep.pixels[shared])
    lit = (sweep.images.sum(axis=(0, 2))[shared] > 0.1) & (np.abs(row[index] - 5.5) < 5)
    assert lit.sum() > 100
    assert np.abs(brightest[shared][lit] - row[index][lit]).max() < 1.1

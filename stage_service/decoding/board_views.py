"""The calibration board in a camera's lit frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from reconstruction import Capture, Rig
from reconstruction.calibration.boards import Board
from reconstruction.images.silhouettes import lit_image

LEAST = 6
"""Corners that determine a board's pose."""


def board_view(
    capture: Path, camera: str, board: list[Any], calibrated: str | None
) -> dict[str, Any]:
    """The fields of `BoardView`, with the capture's lens, or that of the rig file `calibrated` if
    it has this camera. `board` has the arguments of `Board`. Raises `CaptureError`, `NoSilhouette`,
    `CalibrationError`, `RigError`."""
    shot, plane = Capture(capture), Board(*board)
    lens = nominal = shot.rig.camera(camera)
    for other in () if calibrated is None else Rig.load(calibrated).cameras:
        if (other.name, other.width, other.height) == (camera, nominal.width, nominal.height):
            lens = other
    found = plane.find(lit_image(shot, camera))
    view = {
        "corners": len(found),
        "of": len(plane.corners),
        "pixels": _points(found.pixels),
        "lens": "nominal" if lens is nominal else "calibrated",
    }
    flat = plane.corners[found.ids]
    if len(found) < LEAST or np.linalg.matrix_rank(flat - flat.mean(axis=0), 1e-6) < 2:
        return view
    how = lens.K, lens.distortion
    solved, turn, shift = cv2.solvePnP(flat, found.pixels, *how, flags=cv2.SOLVEPNP_IPPE)
    if not solved:
        return view
    turn, shift = cv2.solvePnPRefineLM(flat, found.pixels, *how, turn, shift)
    off = cv2.projectPoints(flat, turn, shift, *how)[0].reshape(-1, 2) - found.pixels
    upright = abs(float(cv2.Rodrigues(turn)[0][2, 2]))
    return view | {
        "off": _points(off),
        "rms_px": float(np.sqrt((off**2).sum(axis=1).mean())),
        "tilt_deg": float(np.degrees(np.arccos(min(1.0, upright)))),
    }


def _points(array: Any) -> list[tuple[float, float]]:
    return [(round(float(x), 3), round(float(y), 3)) for x, y in array]

"""Results and errors of camera files, and names for cameras."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import Any, Literal

import numpy as np

from reconstruction.arrays import Array
from reconstruction.containment import is_file_name
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.lens_models import LensModel, LensModelCamera

CameraAxes = Literal["opencv", "opengl"]
"""x right, y down, z forward; or x right, y up, z backwards."""


EXACT, FEW_DIGITS = 1e-7, 1e-3
"""Difference of R Rᵀ from 1 up to which R is used as it is, and is a rotation of few digits."""


class CameraFileError(ValueError):
    """An invalid camera file; the message names the file, the position and what to do."""


@dataclass(frozen=True)
class CameraFile:
    """Cameras in the file's unit and world axes; `notes` are for the user.

    `metres` is the length of its unit, None if unknown; `unitless` if the format has no unit.
    `axes` are the camera axes of the file.
    """

    cameras: list[Camera]
    notes: list[str] = field(default_factory=list)
    metres: float | None = None
    axes: CameraAxes = "opencv"
    unitless: bool = False


def camera_names(pictures: Sequence[str], where: str) -> list[str]:
    """Camera names from image paths: the stems if all differ.

    Else the innermost folders that all differ, as in `cam_03/all_on.png`. Raises `CameraFileError`
    if there are none, or they are not valid file names.
    """
    paths = [PurePosixPath(p.replace("\\", "/")) for p in pictures]
    depth = max((len(p.parts) for p in paths), default=0)
    for level in range(depth):
        names = [p.stem if level == 0 else (p.parts[-1 - level :] or ("",))[0] for p in paths]
        if len(set(names)) == len(names):
            for name in names:
                if not is_file_name(name):
                    raise CameraFileError(f"{where}: {name!r} is not a valid name")
            return names
    twice = Counter(str(p) for p in paths).most_common(1)[0][0] if paths else ""
    raise CameraFileError(
        f"{where}: image names do not identify cameras: {twice} occurs twice: give each camera a "
        "name or a folder of its own"
    )


def pinhole_K(fx: float, fy: float, cx: float, cy: float, skew: float = 0.0) -> Array:
    """K `(3, 3)` with pixel centres at integers, from a principal point relative to the corner."""
    return np.array([[fx, skew, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1.0]])


def camera_of(
    where: str, name: str, size: tuple[int, int], K: Any, pose: tuple[Any, Any], lens: LensModel
) -> Camera:
    """A `Camera` if it can represent the lens, else a `LensModelCamera`.

    `size` is (width, height), `pose` (R, t); an R of few digits becomes the nearest rotation.
    Raises `CameraFileError`.
    """
    R, t = pose
    off = np.abs(R @ R.T - np.eye(3)).max()
    if EXACT < off < FEW_DIGITS and np.linalg.det(R) > 0:
        U, _, V = np.linalg.svd(R)
        pose = U @ V, t
    try:
        plain = _plain(lens)
        if plain is not None:
            return Camera(name, *size, K, *pose, distortion=plain)
        return LensModelCamera(name, *size, K, *pose, lens=lens)
    except ValueError as error:
        raise CameraFileError(f"{where}: {error}") from error


def _plain(lens: LensModel) -> Array | None:
    """OpenCV's k1, k2, p1, p2, k3 if the lens has no further coefficients."""
    k = lens.coefficients
    if lens.kind == "opencv" and not k[5:].any():
        return k[:5]
    if lens.kind == "metashape" and not (k[3] or k[6] or k[7]):
        return np.array([k[0], k[1], k[5], k[4], k[2]])
    return None

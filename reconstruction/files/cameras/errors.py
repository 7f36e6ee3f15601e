"""What is wrong with a file of cameras, what there is to be said of one, and names for cameras."""

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


class CameraFileError(ValueError):
    """A file of cameras that cannot be used; the message names it, the place and what to do."""


@dataclass(frozen=True)
class CameraFile:
    """Cameras as a file has them, in its own units and axes of the world; `notes` for its user.

    `metres` is the length of its unit where the file says so, else None; `unitless` where its kind
    has none of its own. `axes` are those in which it was read to give its cameras' poses.
    """

    cameras: list[Camera]
    notes: list[str] = field(default_factory=list)
    metres: float | None = None
    axes: CameraAxes = "opencv"
    unitless: bool = False


def camera_names(pictures: Sequence[str], where: str) -> list[str]:
    """What the cameras of `pictures` (paths) are called: the file's stem where all differ.

    Else the innermost folder in which all differ, as in `cam_03/all_on.png`. Raises
    `CameraFileError` where nothing tells them apart, or what does is no file's name.
    """
    paths = [PurePosixPath(p.replace("\\", "/")) for p in pictures]
    depth = max((len(p.parts) for p in paths), default=0)
    for level in range(depth):
        names = [p.stem if level == 0 else (p.parts[-1 - level :] or ("",))[0] for p in paths]
        if len(set(names)) == len(names):
            for name in names:
                if not is_file_name(name):
                    raise CameraFileError(f"{where}: {name!r} cannot be a camera's name")
            return names
    twice = Counter(str(p) for p in paths).most_common(1)[0][0] if paths else ""
    raise CameraFileError(f"{where}: no part of the pictures' names differs for all, as of {twice}")


def pinhole_K(fx: float, fy: float, cx: float, cy: float, skew: float = 0.0) -> Array:
    """K `(3, 3)` of our convention from a principal point that counts from the picture's corner."""
    return np.array([[fx, skew, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1.0]])


def camera_of(
    where: str, name: str, size: tuple[int, int], K: Any, pose: tuple[Any, Any], lens: LensModel
) -> Camera:
    """A `Camera` where that can carry the lens, else a `LensModelCamera`.

    `size` is (width, height), `pose` (R, t). Raises `CameraFileError`.
    """
    try:
        plain = _plain(lens)
        if plain is not None:
            return Camera(name, *size, K, *pose, distortion=plain)
        return LensModelCamera(name, *size, K, *pose, lens=lens)
    except ValueError as error:
        raise CameraFileError(f"{where}: {error}") from error


def _plain(lens: LensModel) -> Array | None:
    """OpenCV's k1, k2, p1, p2, k3, where the lens has no more."""
    k = lens.coefficients
    if lens.kind == "opencv" and not k[5:].any():
        return k[:5]
    if lens.kind == "metashape" and not (k[3] or k[6] or k[7]):
        return np.array([k[0], k[1], k[5], k[4], k[2]])
    return None

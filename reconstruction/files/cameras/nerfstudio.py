"""`transforms.json` of nerfstudio, Instant NGP and Blender's NeRF scenes.

`transform_matrix` maps camera to world, x right, y up, z backwards; the corner of the
top-left pixel is at (0, 0) (docs.nerf.studio, "Data conventions", its ray generator and
`camera_utils._compute_residual_and_jacobian`).
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from reconstruction.arrays import Array
from reconstruction.files.cameras.errors import (
    CameraFile,
    CameraFileError,
    camera_names,
    camera_of,
    pinhole_K,
)
from reconstruction.files.pictures import picture_size
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.lens_models import LensModel

_TO_OPENCV = np.diag([1.0, -1.0, -1.0])
_INTRINSICS = ("fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y", "w", "h")
_OPENCV = ("k1", "k2", "p1", "p2", "k3")
_FISHEYE = ("k1", "k2", "k3", "k4")
_FIELDS = (*_INTRINSICS, *_OPENCV, "k4", "k5", "k6", "camera_model", "is_fisheye")
_NOTED = {
    "applied_transform": "applied_transform is in its poses: results are in its frame",
    "applied_scale": "applied_scale is in its poses: results are in its unit",
}
_PLAIN = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")


def read_transforms(path: Path, data: dict[str, Any]) -> CameraFile:
    """Cameras of a `transforms.json`; frames with the same pose and lens are one camera.

    `frames` may be an object by the cameras' names, as OpenIllumination's. Raises
    `CameraFileError` naming the frame and the field.
    """
    frames = data["frames"]
    if isinstance(frames, dict):
        frames = [{**f, "file_path": k} for k, f in frames.items() if isinstance(f, dict)]
    if not isinstance(frames, list) or not frames or not all(isinstance(f, dict) for f in frames):
        raise CameraFileError(f"{path}: frames: expected a list with at least one object")
    notes = [f"{path}: {text}" for key, text in _NOTED.items() if key in data]
    if masks := sum("mask_path" in frame for frame in frames):
        notes.append(f"{path}: {masks} frames have a mask_path, not used: give pictures.subject")
    groups: dict[bytes, list[str]] = {}
    found: dict[bytes, tuple[str, dict[str, Any], Array]] = {}
    for i, frame in enumerate(frames):
        where = f"{path}: frames[{i}]"
        matrix = _matrix(frame, where)
        fields = {**data, **frame}
        lens = [fields.get(f) for f in _FIELDS]
        if twice := [f for f in _FIELDS if f in data and frame.get(f, data[f]) != data[f]]:
            both = ", ".join(f"{f} {frame[f]} (all frames: {data[f]})" for f in twice)
            notes.append(f"{where}: its own {both} are used")
        key = matrix.tobytes() + repr(lens).encode()
        picture = frame.get("file_path")
        if not isinstance(picture, str) or not picture:
            raise CameraFileError(f"{where}.file_path: expected an image path, got {picture!r}")
        groups.setdefault(key, []).append(picture)
        found.setdefault(key, (where, fields, matrix))
    shared = [_shared(pictures) for pictures in groups.values()]
    names = camera_names(shared, str(path))
    cameras = [
        _camera(path, name, groups[key][0], *found[key])
        for key, name in zip(found, names, strict=True)
    ]
    return CameraFile(cameras, notes, axes="opengl", unitless=True)


def _shared(pictures: list[str]) -> str:
    """An image path, or the common path of a camera's images."""
    if len(pictures) == 1:
        return pictures[0]
    parts = [PurePosixPath(p).parts for p in pictures]
    if len({PurePosixPath(p).stem for p in pictures}) == 1:
        return pictures[0]
    common: list[str] = []
    for words in zip(*parts, strict=False):
        if len(set(words)) > 1:
            break
        common.append(words[0])
    return "/".join(common)


def _matrix(frame: dict[str, Any], where: str) -> Array:
    try:
        matrix = np.array(frame.get("transform_matrix"), dtype=np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape not in ((4, 4), (3, 4)) or not np.isfinite(matrix).all():
        raise CameraFileError(f"{where}.transform_matrix: expected 4x4 finite numbers")
    if matrix.shape == (4, 4) and not np.allclose(matrix[3], (0, 0, 0, 1), atol=1e-6):
        raise CameraFileError(f"{where}.transform_matrix: expected a last row of 0, 0, 0, 1")
    return matrix[:3]


def _number(fields: dict[str, Any], name: str, where: str, default: float | None = None) -> float:
    value = fields.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise CameraFileError(f"{where}: the field {name!r} must be a number, got {value!r}")
    return float(value)


def _size(path: Path, picture: str, fields: dict[str, Any], where: str) -> tuple[int, int]:
    """Width and height from the file, else from the image."""
    if "w" in fields and "h" in fields:
        sizes = [_number(fields, name, where) for name in "wh"]
        if not all(size.is_integer() for size in sizes):
            raise CameraFileError(f"{where}: w and h must be whole numbers, got {sizes}")
        return int(sizes[0]), int(sizes[1])
    for suffix in ("", ".png", ".jpg", ".exr"):
        there = path.parent / (picture + suffix)
        if there.is_file():
            return picture_size(there)
    raise CameraFileError(
        f"{where}: unknown image size: add the fields 'w' and 'h', or the image {picture}"
    )


def _camera(
    path: Path, name: str, picture: str, where: str, fields: dict[str, Any], matrix: Array
) -> Camera:
    model = fields.get("camera_model", "OPENCV")
    fisheye = model == "OPENCV_FISHEYE" or fields.get("is_fisheye") is True
    if not fisheye and model not in _PLAIN:
        raise CameraFileError(f"{where}: expected camera_model OPENCV or a fisheye, got {model!r}")
    size = width, height = _size(path, picture, fields, where)
    if "fl_x" in fields:
        fx = _number(fields, "fl_x", where)
    else:
        fx = _focal(fields, "camera_angle_x", width, where)
    if "fl_y" not in fields and "fl_x" not in fields and "camera_angle_y" in fields:
        fy = _focal(fields, "camera_angle_y", height, where)
    else:
        fy = _number(fields, "fl_y", where, fx)
    K = pinhole_K(
        fx, fy, _number(fields, "cx", where, width / 2), _number(fields, "cy", where, height / 2)
    )
    lens = _lens(fields, fisheye, where)
    R = _TO_OPENCV @ matrix[:, :3].T
    return camera_of(where, name, size, K, (R, -R @ matrix[:, 3]), lens)


def _focal(fields: dict[str, Any], name: str, size: int, where: str) -> float:
    """The focal length in pixels from a field of view across `size` pixels, in radians."""
    angle = _number(fields, name, where)
    if not 0 < angle < np.pi:
        raise CameraFileError(f"{where}: {name} must lie in (0, π), got {angle}")
    return float(0.5 * size / np.tan(angle / 2))


def _lens(fields: dict[str, Any], fisheye: bool, where: str) -> LensModel:
    """nerfstudio's k4 is the coefficient of r⁸, as Metashape's, whose p1 and p2 are exchanged; with
    k5 or k6 it is OpenCV's (COLMAP's FULL_OPENCV)."""

    def numbers(*names: str) -> Array:
        return np.array([_number(fields, k, where, 0.0) for k in names])

    if fisheye:
        return LensModel("fisheye", numbers(*_FISHEYE))
    if numbers("k5", "k6").any():
        return LensModel("opencv", numbers(*_OPENCV, "k4", "k5", "k6"))
    return LensModel("metashape", numbers("k1", "k2", "k3", "k4", "p2", "p1"))

"""Calibrations of `cv::FileStorage` (`.yml`, `.xml`, `.json`) and similar JSON.

One file per camera in a folder, or one with a map per camera. `K` or `camera_matrix`; `dist` or
`distortion_coefficients` in OpenCV's order; `R` (a rotation or Rodrigues vector) or `rvec`, and `T`
or `tvec`, map world to camera; `pose` (4, 4) maps camera to world. The centre of the top-left pixel
is at (0, 0).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from reconstruction.arrays import Array
from reconstruction.containment import is_file_name, plain_file
from reconstruction.files.cameras.errors import CameraFile, CameraFileError, camera_of
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.lens_models import LensModel

_K = ("K", "camera_matrix", "Camera_Matrix", "cameraMatrix", "intrinsic")
_DIST = ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "dist", "D")
_R = ("R", "rotation", "rotation_matrix", "rvec", "Rot")
_T = ("T", "t", "translation", "tvec")
_WIDTH, _HEIGHT = ("image_width", "width", "image_Width"), ("image_height", "height")
_FISHEYE = ("fisheye", "equidistant", "OPENCV_FISHEYE", "kannala_brandt")
SUFFIXES = (".yml", ".yaml", ".xml")


def read_opencv(path: Path) -> CameraFile:
    """One camera, named after the file, or one for each map in it.

    Raises `CameraFileError` naming the field.
    """
    return cameras_from(path, _storage(path))


def read_opencv_folder(folder: Path, files: list[Path]) -> CameraFile:
    """A camera from each file."""
    read = [read_opencv(file) for file in files]
    return CameraFile([c for r in read for c in r.cameras], [n for r in read for n in r.notes])


def cameras_from(path: Path, data: Mapping[str, Any]) -> CameraFile:
    """The camera of `data`, named after the file, or one for each map in it."""
    if any(k in data for k in _K):
        return CameraFile([camera_from(str(path), path.stem, data)])
    maps = {k: v for k, v in data.items() if isinstance(v, Mapping) and any(f in v for f in _K)}
    if not maps:
        raise CameraFileError(f"{path}: expected one of {', '.join(_K)} in it or in a map")
    left = [k for k, v in data.items() if isinstance(v, Mapping) and k not in maps]
    notes = [f"{path}: skipped, without any of {', '.join(_K)}: {', '.join(left)}"]
    cameras = [camera_from(f"{path}: {name}", name, table) for name, table in maps.items()]
    return CameraFile(cameras, notes if left else [])


def camera_from(where: str, name: str, table: Mapping[str, Any]) -> Camera:
    """A camera from a map's fields."""
    if not is_file_name(name):
        raise CameraFileError(f"{where}: {name!r} is not a valid name")
    K = _array(where, table, _K, ((3, 3),))
    size = _size(where, table)
    dist = _array(where, table, _DIST, None) if any(f in table for f in _DIST) else np.zeros(0)
    model = str(table.get("model", table.get("camera_model", table.get("distortion_model", ""))))
    lens = LensModel("fisheye" if model in _FISHEYE else "opencv", dist.ravel())
    return camera_of(where, name, size, K, _pose(where, table), lens)


def _pose(where: str, table: Mapping[str, Any]) -> tuple[Array, Array]:
    if "pose" in table:
        pose = _array(where, table, ("pose",), ((4, 4), (3, 4)))
        R = pose[:3, :3].T
        return R, -R @ pose[:3, 3]
    if not any(f in table for f in _R) or not any(f in table for f in _T):
        raise CameraFileError(
            f"{where}: no pose: give R (or rvec) and T (or tvec), world to camera"
        )
    R = _array(where, table, _R, ((3, 3), (3, 1), (1, 3), (3,)))
    if R.size == 3:
        R = Rotation.from_rotvec(R.ravel()).as_matrix()
    return R, _array(where, table, _T, ((3, 1), (1, 3), (3,))).ravel()


def _size(where: str, table: Mapping[str, Any]) -> tuple[int, int]:
    found = [next((table[f] for f in names if f in table), None) for names in (_WIDTH, _HEIGHT)]
    if found == [None, None] and "image_size" in table:
        found = list(np.asarray(table["image_size"]).ravel()[:2])
    try:
        width, height = (int(str(v).removesuffix(".0")) for v in found)
    except (TypeError, ValueError):
        raise CameraFileError(
            f"{where}: image_width and image_height (or image_size) must be whole numbers"
        ) from None
    return width, height


def _array(
    where: str,
    table: Mapping[str, Any],
    names: tuple[str, ...],
    shapes: tuple[tuple[int, ...], ...] | None,
) -> Array:
    name = next((n for n in names if n in table), None)
    if name is None:
        raise CameraFileError(f"{where}: expected one of {', '.join(names)}")
    given = table[name]
    try:
        if isinstance(given, Mapping):  # OpenCV's JSON
            given = np.reshape(given["data"], (given["rows"], given["cols"]))
        value = np.array(given, dtype=np.float64)
    except (TypeError, ValueError, LookupError):
        value = np.full(1, np.nan)
    if (shapes and value.shape not in shapes) or not np.isfinite(value).all():
        expected = " or ".join(map(str, shapes or ()))
        raise CameraFileError(f"{where}: {name} must be {expected} finite numbers")
    return value


def _storage(path: Path) -> dict[str, Any]:
    """The content of a `cv::FileStorage` file."""
    storage = None
    try:
        storage = cv2.FileStorage(str(plain_file(path)), cv2.FILE_STORAGE_READ)
        root = storage.root() if storage.isOpened() else None
        data = None if root is None else _node(root)
    except (cv2.error, SystemError) as error:
        raise CameraFileError(f"{path}: OpenCV cannot read it ({error})") from error
    finally:
        if storage is not None:
            storage.release()
    if not isinstance(data, dict):
        raise CameraFileError(f"{path}: OpenCV cannot read it as a map of matrices")
    return data


def _matrix(node: Any) -> Any:
    """A matrix from its numbers: OpenCV's own reader aborts the process if there are too few."""
    keys = node.keys()
    sizes = _node(node.getNode("sizes"), 8) if "sizes" in keys else None
    shape = sizes or [node.getNode(k).real() for k in ("rows", "cols")]
    data = node.getNode("data")
    values = [data.at(i).real() for i in range(data.size())] if data.isSeq() else []
    whole = [int(n) for n in shape if isinstance(n, float) and 0 < n <= len(values)]
    if len(whole) != len(shape) or np.prod(whole) != len(values):
        return None
    return np.array(values).reshape(whole)


def _node(node: Any, depth: int = 0) -> Any:
    if depth > 9:
        return None
    if node.isMap():
        keys = node.keys()
        if "data" in keys and ("rows" in keys or "sizes" in keys):
            return _matrix(node)
        return {k: _node(node.getNode(k), depth + 1) for k in keys}
    if node.isSeq():
        return [_node(node.at(i), depth + 1) for i in range(node.size())]
    return node.string() if node.isString() else node.real()

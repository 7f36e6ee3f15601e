"""Calibrations of `cv::FileStorage` (`.yml`, `.xml`, `.json`) and similar JSON.

One file per camera in a folder, one with a map per camera, or EasyMocap's `intri.yml` and
`extri.yml`, whose fields end in a camera's name (`K_01`, `Rot_01`, `T_01`). `K` or `camera_matrix`;
`dist` or `distortion_coefficients` in OpenCV's order; `R` (a rotation or Rodrigues vector) or
`rvec`, and `T` or `tvec`, map world to camera; `pose` (4, 4) maps camera to world. The centre of
the top-left pixel is at (0, 0).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from reconstruction.arrays import Array
from reconstruction.containment import is_file_name, plain_file
from reconstruction.files.cameras.errors import CameraFile, CameraFileError, camera_of
from reconstruction.files.encoded import FORMATS
from reconstruction.files.pictures import picture_size
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.lens_models import LensModel

_K = ("K", "camera_matrix", "Camera_Matrix", "cameraMatrix", "intrinsic")
_DIST = ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "dist", "D")
_R = ("R", "rotation", "rotation_matrix", "rvec", "Rot")
_TURNS = ((3, 3), (3, 1), (1, 3), (3,))
_T = ("T", "t", "translation", "tvec")
_WIDTH = ("image_width", "width", "image_Width")
_HEIGHT = ("image_height", "height", "image_Height")
_FISHEYE = ("fisheye", "equidistant", "opencv_fisheye", "kannala_brandt", "equi")
_PLAIN = {"", "none", "opencv", "full_opencv", "pinhole", "simple_pinhole", "perspective", "frame"}
_PLAIN |= {"plumb_bob", "radtan", "brown", "brown_conrady", "radial", "simple_radial", "standard"}
_PLAIN |= {"rational", "rational_polynomial", "thin_prism"}
EASYMOCAP = ("intri.yml", "extri.yml")
SAME_TURN = 1e-3
"""Largest difference between a rotation matrix and a Rodrigues vector of one camera."""
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


def read_easymocap(folder: Path) -> CameraFile:
    """The cameras of `intri.yml` and `extri.yml`, in the order of their `names`.

    Without `W_` and `H_` the size is that of a camera's first image in `images/NAME`, beside the
    files or one folder up.
    """
    inner, outer = (_storage(folder / name) for name in EASYMOCAP)
    where = str(folder / EASYMOCAP[0])
    there = [key.removeprefix("K_") for key in inner if key.startswith("K_")]
    listed = inner.get("names", outer.get("names"))
    names = [_text(name) for name in listed] if isinstance(listed, list) else there
    by_number = {name.lstrip("0"): name for name in there}  # YAML reads 01 as the number 1
    names = [n if n in there else by_number.get(n, n) for n in names if n != "none"]
    if not names:
        raise CameraFileError(f"{where}: expected names, and K_NAME of each")
    cameras = []
    known: set[str] = set()
    for name in names:
        table = {
            key.removesuffix(f"_{name}"): value
            for key, value in (*inner.items(), *outer.items())
            if key.endswith(f"_{name}")
        }
        known |= {f"{key}_{name}" for key in table}
        size = [table.pop(key, None) for key in "WH"]
        if not all(isinstance(value, float) and value > 0 for value in size):
            size = list(_size_of_images(folder, name))
        table |= dict(zip(("width", "height"), size, strict=True))
        cameras.append(camera_from(f"{where}: {name}", name, table))
    left = [key for key in (*inner, *outer) if key not in known and key != "names"]
    notes = [f"{folder}: not used: {', '.join(dict.fromkeys(left))}"] if left else []
    if bare := [name for name in names if not {f"dist_{name}", f"D_{name}"} & known]:
        notes.append(f"{where}: no distortion of {', '.join(bare)}: 0 is assumed")
    return CameraFile(cameras, notes)


def _text(name: Any) -> str:
    return f"{name:.0f}" if isinstance(name, float) else str(name)


def _size_of_images(folder: Path, name: str) -> tuple[int, int]:
    for images in (folder / "images" / name, folder.parent / "images" / name):
        for file in sorted(images.iterdir()) if is_file_name(name) and images.is_dir() else ():
            if file.suffix.lower() in FORMATS:
                return picture_size(file)
    raise CameraFileError(
        f"{folder}: {name}: unknown image size: add W_{name} and H_{name} to {EASYMOCAP[0]}, or "
        f"images/{name}"
    )


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
    lens = LensModel(_kind(where, table, dist), dist.ravel())
    return camera_of(where, name, size, K, _pose(where, table), lens)


def _kind(where: str, table: Mapping[str, Any], dist: Array) -> Literal["opencv", "fisheye"]:
    """By the names of the model, or the flag that OpenCV's calibration program writes."""
    given = (table.get(f) for f in ("model", "camera_model", "distortion_model"))
    names = [str(name).strip().lower() for name in given if name is not None]
    if table.get("fisheye_model") or any(name in _FISHEYE for name in names):
        return "fisheye"
    unknown = [name for name in names if name not in _PLAIN]
    if unknown and dist.any():
        raise CameraFileError(
            f"{where}: the lens model {unknown[0]!r} is not OpenCV's: undistort the images"
        )
    return "opencv"


def _pose(where: str, table: Mapping[str, Any]) -> tuple[Array, Array]:
    if "pose" in table:
        pose = _array(where, table, ("pose",), ((4, 4), (3, 4)))
        if not np.allclose(pose[3:], (0, 0, 0, 1), atol=1e-6):
            raise CameraFileError(f"{where}: pose: expected a last row of 0, 0, 0, 1")
        R = pose[:3, :3].T
        return R, -R @ pose[:3, 3]
    if not any(f in table for f in _R) or not any(f in table for f in _T):
        raise CameraFileError(
            f"{where}: no pose: give R (or rvec) and T (or tvec), world to camera"
        )
    given = [_array(where, table, (f,), _TURNS) for f in _R if f in table]
    turns = [r if r.size == 9 else Rotation.from_rotvec(r.ravel()).as_matrix() for r in given]
    R = turns[0]
    for other in turns[1:]:
        if np.abs(other - R).max() > SAME_TURN:
            names = " and ".join(f for f in _R if f in table)
            raise CameraFileError(f"{where}: {names} are different rotations: remove one")
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

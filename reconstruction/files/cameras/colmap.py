"""COLMAP's sparse models, text and binary (colmap.github.io/format.html, cameras.html).

Poses map world to camera, x right, y down, z forward; the corner of the top-left pixel is at (0,
0). A model has no unit.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from reconstruction.arrays import Array
from reconstruction.containment import plain_file
from reconstruction.files.cameras.errors import (
    CameraFile,
    CameraFileError,
    camera_names,
    camera_of,
    pinhole_K,
)
from reconstruction.geometry.lens_models import LensModel

MODELS = (
    *(("SIMPLE_PINHOLE", 3), ("PINHOLE", 4), ("SIMPLE_RADIAL", 4), ("RADIAL", 5), ("OPENCV", 8)),
    *(("OPENCV_FISHEYE", 8), ("FULL_OPENCV", 12), ("FOV", 5), ("SIMPLE_RADIAL_FISHEYE", 4)),
    *(("RADIAL_FISHEYE", 5), ("THIN_PRISM_FISHEYE", 12)),
)
"""Names and parameter counts, by COLMAP's model number."""
_COUNTS = dict(MODELS)
_ONE_FOCAL = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE")


@dataclass(frozen=True)
class _Intrinsics:
    size: tuple[int, int]
    K: Array
    lens: LensModel


@dataclass(frozen=True)
class _Image:
    where: str
    quaternion: Array
    t: Array
    camera: int
    name: str


def read_colmap(folder: Path) -> CameraFile:
    """The images of a model in `folder` (`.txt` or `.bin`) as cameras.

    Raises `CameraFileError` naming the file and the line or byte.
    """
    if (folder / "cameras.txt").is_file():
        lenses, images = _text_cameras(folder / "cameras.txt"), _text_images(folder / "images.txt")
    else:
        lenses = _binary_cameras(folder / "cameras.bin")
        images = list(_binary_images(folder / "images.bin"))
    if not images:
        raise CameraFileError(f"{folder}: the model has no registered image")
    cameras = []
    for image, name in zip(
        images, camera_names([i.name for i in images], str(folder)), strict=True
    ):
        if image.camera not in lenses:
            raise CameraFileError(f"{image.where}: no camera {image.camera} in {[*lenses]}")
        if not np.linalg.norm(image.quaternion) > 0:
            raise CameraFileError(f"{image.where}: a quaternion of length 0 is no rotation")
        lens = lenses[image.camera]
        R = Rotation.from_quat(np.roll(image.quaternion, -1)).as_matrix()
        cameras.append(camera_of(image.where, name, lens.size, lens.K, (R, image.t), lens.lens))
    return CameraFile(cameras, unitless=True)


def _intrinsics(where: str, model: str, size: tuple[int, int], params: list[float]) -> _Intrinsics:
    if model not in _COUNTS:
        raise CameraFileError(f"{where}: the camera model {model!r} is unknown")
    if len(params) != _COUNTS[model]:
        raise CameraFileError(
            f"{where}: {model} has {_COUNTS[model]} parameters, got {len(params)}"
        )
    if model in ("FOV", "THIN_PRISM_FISHEYE"):
        raise CameraFileError(
            f"{where}: OpenCV has no lens model {model}: undistort the images with "
            "`colmap image_undistorter` and import its model"
        )
    if not np.isfinite(params).all():
        raise CameraFileError(f"{where}: parameters must be finite, got {params}")
    if model in _ONE_FOCAL:
        params = [params[0], *params]
    fx, fy, cx, cy, *k = params
    lens = LensModel("fisheye" if "FISHEYE" in model else "opencv", np.array(k))
    return _Intrinsics(size, pinhole_K(fx, fy, cx, cy), lens)


def _lines(path: Path) -> Iterator[tuple[str, list[str]]]:
    """Position and words of each line without comments; blank lines are kept."""
    try:
        text = plain_file(path).read_text()
    except FileNotFoundError:
        raise CameraFileError(f"{path}: no such file; a COLMAP model needs it") from None
    except UnicodeDecodeError as error:
        raise CameraFileError(f"{path}: not text ({error})") from error
    for number, line in enumerate(text.splitlines(), 1):
        if not line.startswith("#"):
            yield f"{path}, line {number}", line.split()


def _numbers(where: str, words: list[str]) -> list[float]:
    try:
        return [float(w) for w in words]
    except ValueError as error:
        raise CameraFileError(f"{where}: {error}") from error


def _whole(where: str, word: str) -> int:
    if not word.isdecimal():
        raise CameraFileError(f"{where}: expected a whole number, got {word!r}")
    return int(word)


def _text_cameras(path: Path) -> dict[int, _Intrinsics]:
    out = {}
    for where, words in _lines(path):
        if not words:
            continue
        if len(words) < 5:
            raise CameraFileError(f"{where}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS...")
        size = _whole(where, words[2]), _whole(where, words[3])
        out[_whole(where, words[0])] = _intrinsics(
            where, words[1], size, _numbers(where, words[4:])
        )
    return out


def _text_images(path: Path) -> list[_Image]:
    """Alternating lines: an image, then its points, possibly blank."""
    out = []
    lines = _lines(path)
    for where, words in lines:
        if not words:
            continue
        if len(words) < 10:
            raise CameraFileError(
                f"{where}: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, "
                f"got {len(words)} words"
            )
        values = np.array(_numbers(where, words[1:8]))
        name = " ".join(words[9:])
        out.append(_Image(where, values[:4], values[4:], _whole(where, words[8]), name))
        next(lines, None)
    return out


class _Bytes:
    """A binary file with bounds checks."""

    def __init__(self, path: Path) -> None:
        try:
            self.path, self.data, self.at = path, plain_file(path).read_bytes(), 0
        except FileNotFoundError:
            raise CameraFileError(f"{path}: no such file; a COLMAP model needs it") from None

    def take(self, layout: str) -> tuple[float, ...]:
        size = struct.calcsize("<" + layout)
        self.skip(size)
        return struct.unpack_from("<" + layout, self.data, self.at - size)

    def skip(self, size: int) -> None:
        if self.at + size > len(self.data):
            raise CameraFileError(
                f"{self.path}: ends at byte {len(self.data):,}, expected {size:,} bytes at byte "
                f"{self.at:,}: it is truncated, or not a COLMAP model"
            )
        self.at += size

    def word(self) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise CameraFileError(f"{self.path}: a name at byte {self.at:,} does not end")
        raw, self.at = self.data[self.at : end], end + 1
        return raw.decode("utf-8", "backslashreplace")


def _binary_cameras(path: Path) -> dict[int, _Intrinsics]:
    file, out = _Bytes(path), {}
    for _ in range(int(file.take("Q")[0])):
        where = f"{path}, byte {file.at:,}"
        number, model, width, height = (int(v) for v in file.take("iiQQ"))
        if not 0 <= model < len(MODELS):
            raise CameraFileError(f"{where}: the camera model {model} is unknown")
        name, count = MODELS[model]
        out[number] = _intrinsics(where, name, (width, height), list(file.take(f"{count}d")))
    return out


def _binary_images(path: Path) -> Iterator[_Image]:
    file = _Bytes(path)
    for _ in range(int(file.take("Q")[0])):
        where = f"{path}, byte {file.at:,}"
        _, *values, camera = file.take("i7di")
        name = file.word()
        file.skip(24 * int(file.take("Q")[0]))
        yield _Image(where, np.array(values[:4]), np.array(values[4:]), int(camera), name)

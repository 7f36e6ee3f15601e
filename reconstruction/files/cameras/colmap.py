"""COLMAP's sparse models, text and binary (colmap.github.io/format.html, cameras.html).

Poses map world to camera, x right, y down, z forward; the corner of the top-left pixel is at (0,
0). A model has no unit.
"""

from __future__ import annotations

import re
import struct
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
from reconstruction.reading import read_text

OFF_UNIT = 0.01
"""Difference of a quaternion's length from 1 that is noted."""

MODELS = (
    *(("SIMPLE_PINHOLE", 3), ("PINHOLE", 4), ("SIMPLE_RADIAL", 4), ("RADIAL", 5), ("OPENCV", 8)),
    *(("OPENCV_FISHEYE", 8), ("FULL_OPENCV", 12), ("FOV", 5), ("SIMPLE_RADIAL_FISHEYE", 4)),
    *(("RADIAL_FISHEYE", 5), ("THIN_PRISM_FISHEYE", 12), ("RAD_TAN_THIN_PRISM_FISHEYE", 16)),
)
"""Names and parameter counts, by COLMAP's model number."""
_COUNTS = dict(MODELS)
_ONE_FOCAL = (
    "SIMPLE_PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
)
_OTHERS = ("FOV", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE")


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


def read_colmap(folder: Path, suffix: str = "") -> CameraFile:
    """The images of a model in `folder` as cameras, from its `.txt` or `.bin` by `suffix`.

    Without one the binary files come first, as COLMAP has it. Raises `CameraFileError` naming the
    file and the line or byte.
    """
    notes: list[str] = []
    there = [s for s in (".bin", ".txt") if (folder / f"cameras{s}").is_file()]
    if not suffix and len(there) == 2:
        notes.append(f"{folder}: the model's .bin files are read, its .txt files are not")
    if (suffix or there[0]) == ".txt":
        lenses = _text_cameras(folder / "cameras.txt", notes)
        images = _text_images(folder / "images.txt", notes)
    else:
        lenses = _binary_cameras(folder / "cameras.bin")
        images = _binary_images(folder / "images.bin")
    if not images:
        raise CameraFileError(f"{folder}: the model has no registered image")
    cameras = []
    for image, name in zip(
        images, camera_names([i.name for i in images], str(folder)), strict=True
    ):
        if image.camera not in lenses:
            raise CameraFileError(f"{image.where}: no camera {image.camera} in {[*lenses]}")
        norm = float(np.linalg.norm(image.quaternion))
        if not norm > 0:
            raise CameraFileError(f"{image.where}: a quaternion of length 0 is no rotation")
        if abs(norm - 1) > OFF_UNIT:
            notes.append(f"{image.where}: the quaternion has length {norm:.4g}; it is normalised")
        lens = lenses[image.camera]
        R = Rotation.from_quat(np.roll(image.quaternion, -1)).as_matrix()
        cameras.append(camera_of(image.where, name, lens.size, lens.K, (R, image.t), lens.lens))
    if unused := set(lenses) - {image.camera for image in images}:
        notes.append(f"{folder}: no image is of the cameras {', '.join(map(str, sorted(unused)))}")
    return CameraFile(cameras, notes, unitless=True)


def _intrinsics(where: str, model: str, size: tuple[int, int], params: list[float]) -> _Intrinsics:
    if model not in _COUNTS:
        raise CameraFileError(f"{where}: the camera model {model!r} is unknown")
    if len(params) != _COUNTS[model]:
        raise CameraFileError(
            f"{where}: {model} has {_COUNTS[model]} parameters, got {len(params)}"
        )
    if model in _OTHERS:
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


def _lines(path: Path) -> list[tuple[str, str]]:
    """Position and text of each line; blank lines and comments are kept."""
    try:
        text = read_text(path)
    except FileNotFoundError:
        raise CameraFileError(f"{path}: no such file; a COLMAP model needs it") from None
    return [(f"{path}, line {n}", line.strip()) for n, line in enumerate(text.split("\n"), 1)]


def _check_count(lines: list[tuple[str, str]], count: int, notes: list[str]) -> None:
    """Note a comment such as `# Number of images: 6` that differs from `count`."""
    for where, line in lines:
        found = re.match(r"#\s*Number of (images|cameras):\s*(\d+)", line)
        if found and int(found[2]) != count:
            notes.append(f"{where}: the file claims {found[2]} {found[1]}, it has {count}")


def _numbers(where: str, words: list[str]) -> list[float]:
    try:
        return [float(w) for w in words]
    except ValueError as error:
        raise CameraFileError(f"{where}: {error}") from error


def _whole(where: str, word: str) -> int:
    if not word.isdecimal():
        raise CameraFileError(f"{where}: expected a whole number, got {word!r}")
    return int(word)


def _text_cameras(path: Path, notes: list[str]) -> dict[int, _Intrinsics]:
    out: dict[int, _Intrinsics] = {}
    lines = _lines(path)
    for where, line in lines:
        words = line.split()
        if not words or line.startswith("#"):
            continue
        if len(words) < 5:
            raise CameraFileError(f"{where}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS...")
        size = _whole(where, words[2]), _whole(where, words[3])
        number = _whole(where, words[0])
        if number in out:
            raise CameraFileError(f"{where}: the camera {number} occurs twice")
        out[number] = _intrinsics(where, words[1], size, _numbers(where, words[4:]))
    _check_count(lines, len(out), notes)
    return out


_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_IMAGE = re.compile(rf"(\d+)((?:\s+{_NUMBER}){{7}})\s+(\d+)\s+(\S.*)")
_POINTS = re.compile(rf"(?:{_NUMBER}\s+{_NUMBER}\s+(?:-1|\d+)(?:\s+|$))+")


def _text_images(path: Path, notes: list[str]) -> list[_Image]:
    """Images; a line of the points of an image may follow it, blank or not, or be left out."""
    out: list[_Image] = []
    lines = _lines(path)
    after_image = False
    for where, line in lines:
        if line.startswith("#"):
            continue
        points, image = _POINTS.fullmatch(line), _IMAGE.fullmatch(line)
        skipped = not line or (points and after_image)
        after_image = not skipped
        if skipped:
            continue
        if points or not image:
            raise CameraFileError(
                f"{where}: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, or the points (X "
                f"Y POINT3D_ID)... of an image, got {len(line.split())} words: {line[:60]!r}"
            )
        values = np.array([float(w) for w in image[2].split()])
        out.append(_Image(where, values[:4], values[4:], int(image[3]), image[4]))
    _check_count(lines, len(out), notes)
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

    def end(self) -> None:
        """Raise `CameraFileError` for bytes after the last record."""
        if self.at < len(self.data):
            raise CameraFileError(
                f"{self.path}: the {len(self.data) - self.at:,} bytes from byte {self.at:,} on "
                "belong to no record: its count is wrong, or it is no COLMAP model"
            )


def _binary_cameras(path: Path) -> dict[int, _Intrinsics]:
    file, out = _Bytes(path), dict[int, _Intrinsics]()
    for _ in range(int(file.take("Q")[0])):
        where = f"{path}, byte {file.at:,}"
        number, model, width, height = (int(v) for v in file.take("iiQQ"))
        if not 0 <= model < len(MODELS):
            raise CameraFileError(f"{where}: the camera model {model} is unknown")
        name, count = MODELS[model]
        if number in out:
            raise CameraFileError(f"{where}: the camera {number} occurs twice")
        out[number] = _intrinsics(where, name, (width, height), list(file.take(f"{count}d")))
    file.end()
    return out


def _binary_images(path: Path) -> list[_Image]:
    file, out = _Bytes(path), []
    for _ in range(int(file.take("Q")[0])):
        where = f"{path}, byte {file.at:,}"
        _, *values, camera = file.take("i7di")
        name = file.word()
        file.skip(24 * int(file.take("Q")[0]))
        out.append(_Image(where, np.array(values[:4]), np.array(values[4:]), int(camera), name))
    file.end()
    return out

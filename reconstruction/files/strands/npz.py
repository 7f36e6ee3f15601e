"""NumPy archives: `points (N, 3)`, `offsets (S + 1,)` and, optionally, `radius` () or (N,) and
`confidence` (N,).

Poses of moving strands are `points (T, N, 3)`.
"""

from __future__ import annotations

import math
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from reconstruction.files.durable import writing
from reconstruction.files.strands.errors import StrandFileError
from reconstruction.geometry.strands import Strands

DEFLATE_AT_BEST = 1032
"""Bytes that one compressed byte can stand for in a deflated member, at the very most."""


def read_npz(path: Path) -> Strands:
    """Read an archive; other members than those of the module's text are not looked at."""
    points, offsets, radius, confidence = _members(path)
    if points.ndim != 2 or points.shape[1] != 3:
        raise StrandFileError(f"points must be (N, 3), got {points.shape}")
    return Strands(points, offsets, radius, confidence)


def read_npz_poses(path: Path) -> list[Strands]:
    """Read the poses of an archive, one where its points are `(N, 3)`."""
    points, offsets, radius, confidence = _members(path)
    if points.ndim == 2:
        points = points[None]
    if points.ndim != 3 or points.shape[2] != 3 or not len(points):
        raise StrandFileError(f"points must be (N, 3) or (T, N, 3), got {points.shape}")
    return [Strands(pose, offsets, radius, confidence) for pose in points]


def _members(
    path: Path,
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any] | float, NDArray[Any] | None]:
    try:
        with zipfile.ZipFile(path) as archive:
            points = _member(archive, "points", "f")
            offsets = _member(archive, "offsets", "iu")
            radius: NDArray[Any] | float = 4e-5
            if "radius.npy" in archive.namelist():
                radius = _member(archive, "radius", "f")
            confidence = None
            if "confidence.npy" in archive.namelist():
                confidence = _member(archive, "confidence", "f")
    except (zipfile.BadZipFile, zipfile.LargeZipFile, zlib.error, EOFError, OSError) as e:
        raise StrandFileError(f"not a whole .npz archive ({e})") from e
    except RuntimeError as e:  # encrypted, or packed in a way that is not known
        raise StrandFileError(f"not a whole .npz archive ({e})") from e
    if isinstance(radius, np.ndarray) and radius.ndim == 0:
        radius = float(radius)
    return points, offsets, radius, confidence


def write_npz(path: Path, strands: Strands) -> None:
    """Write `points`, `offsets`, `radius` and, where it is known, `confidence`, uncompressed."""
    arrays: dict[str, NDArray[Any]] = {
        "points": strands.points,
        "offsets": strands.offsets,
        "radius": np.asarray(strands.radius, np.float32),
    }
    if strands.confidence is not None:
        arrays["confidence"] = strands.confidence
    with writing(path) as temporary:
        np.savez(temporary, allow_pickle=False, **arrays)


def _member(archive: zipfile.ZipFile, name: str, kinds: str) -> NDArray[Any]:
    """One array, read only if its header, its member and the file agree on its size."""
    try:
        info = archive.getinfo(name + ".npy")
    except KeyError:
        held = [n.removesuffix(".npy") for n in archive.namelist()]
        raise StrandFileError(f"{name} is missing; the archive holds {held}") from None
    if info.file_size > DEFLATE_AT_BEST * (info.compress_size + 64):
        raise StrandFileError(
            f"{name}: {info.compress_size} compressed bytes cannot hold {info.file_size}"
        )
    with archive.open(info) as file:
        try:
            version = npy.read_magic(file)
            if version == (1, 0):
                shape, fortran, dtype = npy.read_array_header_1_0(file)
            elif version == (2, 0):
                shape, fortran, dtype = npy.read_array_header_2_0(file)
            else:
                raise ValueError(f"unknown .npy version {version}")
        except ValueError as error:
            raise StrandFileError(f"{name}: {error}") from error
        if dtype.kind not in kinds or dtype.hasobject:
            raise StrandFileError(f"{name}: unexpected type {dtype}")
        if any(n < 0 for n in shape):
            raise StrandFileError(f"{name}: absurd shape {shape}")
        expected = math.prod(shape) * dtype.itemsize
        if expected > info.file_size:
            raise StrandFileError(
                f"{name}: shape {shape} of {dtype} needs {expected} bytes, "
                f"the archive has {info.file_size}"
            )
        data = file.read(expected)
    if len(data) != expected:
        raise StrandFileError(f"{name}: truncated, {len(data)} of {expected} bytes")
    return np.frombuffer(data, dtype).reshape(shape, order="F" if fortran else "C").copy()

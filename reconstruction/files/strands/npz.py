"""NumPy archives: `points (N, 3)`, `offsets (S + 1,)` and, optionally, `radius` () or (N,) and
`confidence` (N,).

Poses of moving strands are `points (T, N, 3)`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reconstruction.files.durable import writing
from reconstruction.files.numpy_files import member, names, opened
from reconstruction.files.strands.errors import StrandFileError
from reconstruction.geometry.strands import Strands


def read_npz(path: Path) -> Strands:
    """Read an archive; other members are ignored."""
    points, offsets, radius, confidence = _members(path)
    if points.ndim != 2 or points.shape[1] != 3:
        raise StrandFileError(f"points must be (N, 3), got {points.shape}")
    return Strands(points, offsets, radius, confidence)


def read_npz_poses(path: Path) -> list[Strands]:
    """Read the poses of an archive, one for points `(N, 3)`."""
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
        with opened(path) as archive:
            points = member(archive, "points", "f")
            offsets = member(archive, "offsets", "iu")
            there = names(archive)
            radius: NDArray[Any] | float = 4e-5
            if "radius" in there:
                radius = member(archive, "radius", "f")
            confidence = None
            if "confidence" in there:
                confidence = member(archive, "confidence", "f")
    except ValueError as e:
        raise StrandFileError(str(e)) from e
    if isinstance(radius, np.ndarray) and radius.ndim == 0:
        radius = float(radius)
    return points, offsets, radius, confidence


def write_npz(path: Path, strands: Strands) -> None:
    """Write `points`, `offsets`, `radius` and, if known, `confidence`, uncompressed."""
    arrays: dict[str, NDArray[Any]] = {
        "points": strands.points,
        "offsets": strands.offsets,
        "radius": np.asarray(strands.radius, np.float32),
    }
    if strands.confidence is not None:
        arrays["confidence"] = strands.confidence
    with (
        writing(path) as temporary,
        temporary.open("wb") as file,
    ):  # for a name numpy appends ".npz"
        np.savez(file, allow_pickle=False, **arrays)

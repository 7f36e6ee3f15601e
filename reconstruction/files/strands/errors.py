"""The error of every strand file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Ints
from reconstruction.geometry.strands import Strands


class StrandFileError(ValueError):
    """A strand file that cannot be read or written; the message names the file and the reason."""


def strands_of(
    path: Path, points: NDArray[Any], offsets: NDArray[Any], radius: float | NDArray[Any] = 4e-5
) -> Strands:
    """`Strands` of `points (N, 3)` and `offsets (S + 1,)`; complaints are raised as this file's."""
    try:
        return Strands(points, offsets, radius)
    except (ValueError, TypeError, OverflowError) as error:
        raise StrandFileError(f"{path}: {error}") from error


def require_finite(path: Path, points: NDArray[Any], byte_of: Ints | range) -> None:
    """Raise `StrandFileError` where one of `points (N, 3)` is not finite.

    `byte_of (N,)` says where in the file each point begins.
    """
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise StrandFileError(
            f"{path}: byte {byte_of[bad[0]]}: expected a finite position, got "
            f"{points[bad[0]].tolist()}; {len(bad)} of {len(points)} points are not finite"
        )

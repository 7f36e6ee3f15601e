"""Checks and errors of strand files."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Floats, Ints

THINNEST = 1e-6
"""Metres: the radius of a point whose file has a width of 0, as at a tip."""


class StrandFileError(ValueError):
    """A strand file that cannot be read or written; the message names file and reason."""


def require_finite(points: NDArray[Any], byte_of: Ints | range) -> None:
    """Raise `StrandFileError` if one of `points (N, 3)` is not finite.

    `byte_of (N,)` are the points' byte offsets in the file.
    """
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise StrandFileError(
            f"byte {byte_of[bad[0]]}: expected a finite position, got "
            f"{points[bad[0]].tolist()}; {len(bad)} of {len(points)} points are not finite"
        )


def radii(widths: NDArray[Any]) -> float | Floats | None:
    """Radii of widths `(N,)`: a scalar if all are equal, None if all are 0.

    Raises `StrandFileError` for a width that is negative or not finite.
    """
    bad = np.flatnonzero(~(np.isfinite(widths) & (widths >= 0)))
    if len(bad):
        raise StrandFileError(
            f"the width of point {bad[0]} is {widths[bad[0]]}, expected 0 or more; {len(bad)} of "
            f"{len(widths)} widths are wrong"
        )
    if not widths.any():
        return None
    half = np.maximum(widths / 2, THINNEST).astype(np.float32)
    return float(half[0]) if (half == half[0]).all() else half

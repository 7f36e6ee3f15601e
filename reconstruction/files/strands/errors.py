"""Errors of strand files."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Ints


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

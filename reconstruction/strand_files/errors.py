"""The error of every strand file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from reconstruction.strands import Strands


class StrandFileError(ValueError):
    """A strand file that cannot be read or written; the message names the file and the reason."""


def strands_of(
    path: Path, points: NDArray[Any], offsets: NDArray[Any], radius: float | NDArray[Any] = 4e-5
) -> Strands:
    """`Strands`, whose complaints are raised as this file's."""
    try:
        return Strands(points, offsets, radius)
    except (ValueError, TypeError, OverflowError) as error:
        raise StrandFileError(f"{path}: {error}") from error

"""Strand files in and out: `.npz`, cyHair `.hair`, USD curves; TressFX `.tfx` and USC `.data` in;
Alembic curves out.

    strands = read_strands("groom.hair")
    write_strands("groom.usdc", strands)

The suffix says the format. The readers say what is wrong with a file, `read_strands` which it is,
and none trusts a header: what it claims is held against the file's size before anything is
allocated.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np

from reconstruction.files.strands.alembic import write_abc
from reconstruction.files.strands.cyhair import read_hair, write_hair
from reconstruction.files.strands.errors import StrandFileError
from reconstruction.files.strands.npz import read_npz, read_npz_poses, write_npz
from reconstruction.files.strands.photobooth import read_data
from reconstruction.files.strands.tressfx import read_tfx
from reconstruction.files.strands.usd import read_usd, write_usd
from reconstruction.geometry.strands import Strands

__all__ = [
    "READABLE",
    "WRITABLE",
    "StrandFileError",
    "read_poses",
    "read_strands",
    "write_strands",
]

_USD = (".usd", ".usda", ".usdc")
_READERS: dict[str, Callable[[Path], Strands]] = {
    **{".npz": read_npz, ".hair": read_hair, ".tfx": read_tfx, ".data": read_data},
    **dict.fromkeys(_USD, read_usd),
}
_WRITERS: dict[str, Callable[[Path, Strands], None]] = {
    **{".npz": write_npz, ".hair": write_hair},
    **dict.fromkeys(_USD, write_usd),
    ".abc": write_abc,
}
READABLE = tuple(_READERS)
WRITABLE = tuple(_WRITERS)

_Y_UP_TO_Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


def read_strands(path: str | Path, up_axis: Literal["z", "y"] = "z") -> Strands:
    """Read strands from a file of any of the formats `READABLE`, root first.

    Only USD says which way is up and what its unit is, and comes out in metres with z up whatever
    `up_axis` is. The others are read as metres, and `up_axis="y"` turns a y-up file so that z is up
    ((x, y, z) becomes (x, -z, y)).

    Raises `StrandFileError` (a `ValueError`) naming the file and what is wrong with it.
    """
    path = Path(path)
    if up_axis not in ("z", "y"):
        raise ValueError(f"up_axis must be 'z' or 'y', got {up_axis!r}")
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise StrandFileError(
            f"{path}: unknown strand format {path.suffix!r}; readable are {', '.join(READABLE)}"
        )
    if not path.is_file():
        raise StrandFileError(f"{path}: no such file")
    try:
        strands = reader(path)
    except (ValueError, TypeError, OverflowError) as error:
        raise StrandFileError(f"{path}: {error}") from error
    if up_axis == "y" and reader is not read_usd:
        return strands.transformed(_Y_UP_TO_Z_UP, np.zeros(3))
    return strands


def read_poses(path: str | Path) -> list[Strands]:
    """Read strands that move: an `.npz` of points (T, N, 3); one pose of any other file.

    Raises `StrandFileError` as `read_strands` does.
    """
    path = Path(path)
    if path.suffix.lower() != ".npz":
        return [read_strands(path)]
    if not path.is_file():
        raise StrandFileError(f"{path}: no such file")
    try:
        return read_npz_poses(path)
    except (ValueError, TypeError, OverflowError) as error:
        raise StrandFileError(f"{path}: {error}") from error


def write_strands(path: str | Path, strands: Strands) -> None:
    """Write strands in the format that the suffix names (one of `WRITABLE`), in metres, z up.

    Alembic alone is y up, as is its custom, and needs the extra `alembic`.
    Written under a temporary name, flushed and renamed: afterwards the file is whole or not there.
    Raises `StrandFileError` when the format is unknown or cannot hold these strands.
    """
    path = Path(path)
    writer = _WRITERS.get(path.suffix.lower())
    if writer is None:
        raise StrandFileError(
            f"{path}: cannot write the format {path.suffix!r}; writable are {', '.join(WRITABLE)}"
        )
    writer(path, strands)

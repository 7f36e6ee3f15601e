"""Strand files in and out: `.npz`, cyHair `.hair`, `.ply`, USD and Alembic curves; `.tfx` and USC
`.data` in.

    strands = read_strands("groom.hair")
    write_strands("groom.usdc", strands)

The suffix determines the format. Readers check the header against the file's size before any
allocation.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np

from reconstruction.files.strands.alembic import read_abc, write_abc
from reconstruction.files.strands.cyhair import read_hair, write_hair
from reconstruction.files.strands.errors import StrandFileError
from reconstruction.files.strands.npz import read_npz, read_npz_poses, write_npz
from reconstruction.files.strands.photobooth import read_data
from reconstruction.files.strands.ply import read_ply_strands, write_ply_strands
from reconstruction.files.strands.tressfx import read_tfx
from reconstruction.geometry.strands import Strands
from reconstruction.geometry.world_frame import WorldFrame

__all__ = [
    "READABLE",
    "WRITABLE",
    "StrandFileError",
    "read_poses",
    "read_strands",
    "write_strands",
]

_USD = (".usd", ".usda", ".usdc")


def _read_usd(path: Path) -> Strands:
    from reconstruction.files.strands.usd import read_usd  # loads USD's libraries

    return read_usd(path)


def _write_usd(path: Path, strands: Strands, frame: WorldFrame | None = None) -> None:
    from reconstruction.files.strands.usd import write_usd

    write_usd(path, strands, frame)


_READERS: dict[str, Callable[[Path], Strands]] = {
    **{".npz": read_npz, ".hair": read_hair, ".tfx": read_tfx, ".data": read_data},
    **{".ply": read_ply_strands, ".abc": read_abc},
    **dict.fromkeys(_USD, _read_usd),
}
_WRITERS: dict[str, Callable[[Path, Strands], None]] = {
    **{".npz": write_npz, ".hair": write_hair},
    **dict.fromkeys(_USD, _write_usd),
    **{".ply": write_ply_strands, ".abc": write_abc},
}
READABLE = tuple(_READERS)
WRITABLE = tuple(_WRITERS)

_Y_UP_TO_Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


def read_strands(
    path: str | Path, up_axis: Literal["z", "y"] = "z", frame: WorldFrame | None = None
) -> Strands:
    """Read strands from a file of any of the formats `READABLE`, root first.

    USD is converted to metres with z up, whatever `up_axis` is. Other formats are read as metres;
    `up_axis="y"`, as of Alembic by custom, converts y up to z up, (x, y, z) to (x, -z, y). Strands
    in the user's `frame` are converted to the stage's.

    Raises `StrandFileError` (a `ValueError`) naming the file and the error.
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
    if frame is not None:
        return (frame.as_read_from_usd if reader is _read_usd else frame).inputs(strands)
    if (up_axis == "y" or reader is read_abc) and reader is not _read_usd:
        return strands.transformed(_Y_UP_TO_Z_UP, np.zeros(3))
    return strands


def read_poses(path: str | Path, frame: WorldFrame | None = None) -> list[Strands]:
    """Read animated strands: an `.npz` of points (T, N, 3), or one pose of any other file.

    Poses in the user's `frame` are converted to the stage's. Raises `StrandFileError` as
    `read_strands` does.
    """
    path = Path(path)
    if path.suffix.lower() != ".npz":
        return [read_strands(path, frame=frame)]
    if not path.is_file():
        raise StrandFileError(f"{path}: no such file")
    try:
        poses = read_npz_poses(path)
    except (ValueError, TypeError, OverflowError) as error:
        raise StrandFileError(f"{path}: {error}") from error
    return poses if frame is None else [frame.inputs(pose) for pose in poses]


def write_strands(path: str | Path, strands: Strands, frame: WorldFrame | None = None) -> None:
    """Write strands in the format that the suffix names (one of `WRITABLE`), in metres, z up.

    Alembic is y up, by custom, and needs the extra `alembic`. With `frame`, strands of the stage
    are written in the user's frame and unit, whatever the format; USD states both. Writes are
    atomic. Raises `StrandFileError` for an unknown format or strands that it cannot store.
    """
    path = Path(path)
    writer = _WRITERS.get(path.suffix.lower())
    if writer is None:
        raise StrandFileError(
            f"{path}: cannot write the format {path.suffix!r}; writable are {', '.join(WRITABLE)}"
        )
    if frame is None:
        writer(path, strands)
    elif writer is _write_usd:
        _write_usd(path, frame.results(strands), frame)
    elif writer is write_abc:
        write_abc(path, frame.results(strands), turned=False)
    else:
        writer(path, frame.results(strands))

"""Point files of digitisers and scanners."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from reconstruction.arrays import Array
from reconstruction.containment import plain_file
from reconstruction.files.numpy_files import read_array
from reconstruction.files.ply import read_ply

SUFFIXES = (".obj", ".ply", ".csv", ".npy")


def read_points(path: str | Path) -> tuple[Array, Array | None]:
    """Points `(N, 3)` of a file, and unit normals `(N, 3)` if it has one for each.

    `.obj` and `.ply`: vertices. `.csv`: x, y, z and an optional normal per line, separated by
    commas, semicolons or blanks, with an optional header; with semicolons, commas are decimal.
    `.npy`: `(N, 3)` or `(N, 6)`. Raises `ValueError` naming the file and the error.
    """
    path = Path(path)
    readers: dict[str, Callable[[Path], Any]]
    readers = {".obj": _obj, ".ply": _ply, ".csv": _csv, ".npy": read_array}
    if path.suffix.lower() not in readers:
        raise ValueError(f"{path}: expected a file of points ({', '.join(SUFFIXES)})")
    try:
        rows = np.asarray(readers[path.suffix.lower()](plain_file(path)), np.float64)
    except (ValueError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: {error}") from error
    if rows.ndim != 2 or rows.shape[1] not in (3, 6) or not len(rows):
        raise ValueError(f"{path}: expected (N, 3) or (N, 6) numbers, got {rows.shape}")
    if not np.isfinite(rows).all():
        bad = int(np.flatnonzero(~np.isfinite(rows).all(axis=1))[0])
        raise ValueError(f"{path}: point {bad} is not finite: {rows[bad].tolist()}")
    length = np.linalg.norm(rows[:, 3:], axis=1, keepdims=True)
    if not (length > 0).all():
        return rows[:, :3], None
    return rows[:, :3], rows[:, 3:] / length


def _obj(path: Path) -> Array:
    words = [line.split() for line in path.read_text().splitlines()]
    points = [w[1:4] for w in words if w[:1] == ["v"]]
    normals = [w[1:4] for w in words if w[:1] == ["vn"]]
    rows = np.array(points, np.float64)
    if len(normals) == len(points) and points:
        rows = np.hstack([rows, np.array(normals, np.float64)])
    return rows


def _csv(path: Path) -> Array:
    rows: list[list[float]] = []
    content = path.read_text(encoding="utf-8-sig")  # byte order mark of spreadsheets
    for number, line in enumerate(content.splitlines(), 1):
        text = line.partition("#")[0]
        if ";" in text:  # decimal commas
            text = text.replace(",", ".")
        words = [w for w in re.split(r"[,;\s]+", text.strip()) if w]
        if not words:
            continue
        try:
            rows.append([float(w) for w in words])
        except ValueError:
            if number > 1:
                raise ValueError(f"line {number}: expected numbers, got {line!r}") from None
            continue
        if len(rows[-1]) != len(rows[0]):
            raise ValueError(f"line {number}: {len(rows[-1])} numbers, expected {len(rows[0])}")
    return np.array(rows, np.float64)


def _ply(path: Path) -> Array:
    """The vertices of a PLY, with their normals."""
    vertices = read_ply(path).get("vertex", {})
    wanted = ["x", "y", "z"]
    if not set(wanted) <= set(vertices):
        raise ValueError(f"a vertex has {list(vertices)}, expected x, y and z")
    if {"nx", "ny", "nz"} <= set(vertices):
        wanted += ["nx", "ny", "nz"]
    return np.stack([vertices[n].astype(np.float64) for n in wanted], axis=1)

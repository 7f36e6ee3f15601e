"""Reading strands of `.ply` files, as the neural methods write them: vertices, strand by strand.

A PLY has no strands. Their ends are, in this order: where no edge goes on from a vertex to the
next; where the number of the strand or the colour changes, one for each strand; where the step to
the next vertex is `GAP` times its neighbours, for strands of the same number of points.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Floats, Ints
from reconstruction.files.ply import read_ply
from reconstruction.files.strands.errors import StrandFileError, require_finite
from reconstruction.geometry.strands import Strands

GAP = 3.0
SHARE = 0.5
"""Least share of the strands' ends that are gaps, and of the turns that are under 60 degrees."""
_NUMBERS = ("strand", "strand_id", "strand_index", "hair_id", "curve_id")
_COLOURS = ("red", "green", "blue", "alpha")


def read_ply_strands(path: Path) -> Strands:
    """Read the strands of a `.ply` file, in the file's own frame and unit."""
    elements = read_ply(path)
    vertices = elements.get("vertex", {})
    if not {"x", "y", "z"} <= set(vertices):
        raise StrandFileError(f"a vertex has {list(vertices)}, expected x, y and z")
    points = np.stack([vertices[n].astype(np.float32) for n in "xyz"], axis=1)
    require_finite(points, np.arange(len(points)))
    if len(points) < 2:
        raise StrandFileError(f"{len(points)} vertices make no strand")
    last = len(points) - 1
    if edges := elements.get("edge"):
        first, second = (edges[f"vertex{k}"].astype(np.int64) for k in (1, 2))
        if (np.abs(second - first) != 1).any() or min(first.min(), second.min()) < 0:
            raise StrandFileError("an edge joins vertices that do not follow each other")
        joined = np.zeros(len(points), bool)
        joined[np.minimum(first, second)] = True
        return _split(points, np.flatnonzero(~joined[:last]))
    for names in ([n for n in _NUMBERS if n in vertices], [n for n in _COLOURS if n in vertices]):
        if not names:
            continue
        keys = np.stack([vertices[n] for n in names], axis=1)
        ends = np.flatnonzero((keys[1:] != keys[:-1]).any(axis=1))
        if names[0] in _NUMBERS:
            return _split(points, ends)
        if len(ends) and (count := _common(ends, len(points))) >= 2:
            return _even(points, count)
    steps = np.diff(points, axis=0)
    step = np.linalg.norm(steps, axis=1)
    beside = np.maximum(np.append(step[1:], 0), np.append(0, step[:-1]))
    gaps = np.flatnonzero(step > GAP * beside)
    count = _common(gaps, len(points))
    straight = np.einsum("ni,ni->n", steps[1:], steps[:-1]) > 0.5 * step[1:] * step[:-1]
    few = len(gaps) < SHARE * (len(points) // count - 1)
    if count < 3 or few or straight.mean() < SHARE:
        raise StrandFileError(
            "the strands' ends are unknown: vertices need a strand_id, one colour for each strand, "
            "edges, or the same number of points for each strand"
        )
    return _even(points, count)


def _common(ends: Ints, vertices: int) -> int:
    """The most points of strands that all end at some of `ends`."""
    return int(np.gcd.reduce(np.append(ends + 1, vertices)))


def _even(points: Floats, count: int) -> Strands:
    return Strands(points, np.arange(0, len(points) + 1, count))


def _split(points: Floats, ends: NDArray[Any]) -> Strands:
    return Strands(points, np.concatenate([[0], ends + 1, [len(points)]]))

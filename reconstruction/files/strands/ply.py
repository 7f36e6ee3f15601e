"""Strands of `.ply` files, as the neural methods write them: vertices, strand by strand.

A PLY has no strands. Their ends are, in this order: where no edge leads from a vertex to the
next; where the number of the strand or the colour changes, one for each strand; where the step to
the next vertex is `GAP` times its neighbours, for strands of the same number of points.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Bools, Floats
from reconstruction.files.durable import writing
from reconstruction.files.ply import read_ply
from reconstruction.files.strands.errors import StrandFileError, radii, require_finite
from reconstruction.geometry.strands import Strands

GAP = 3.0
SHARE = 0.5
"""Least share of ends that are where they must be, and of turns under 60 degrees."""
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
    if not len(points) and "edge" in elements:
        return Strands(points, np.zeros(1, np.int64))
    if len(points) < 2:
        raise StrandFileError(f"{len(points)} vertices make no strand")
    radius = radii(2.0 * vertices["radius"]) if "radius" in vertices else None
    if edges := elements.get("edge"):
        return _split(points, ~_joined(edges, len(points)), radius)
    number = next((vertices[n] for n in _NUMBERS if n in vertices), None)
    if number is not None:
        return _split(points, number[1:] != number[:-1], radius)
    steps = np.diff(points, axis=0)
    step = np.linalg.norm(steps, axis=1)
    gaps = step > GAP * np.maximum(np.append(step[1:], 0), np.append(0, step[:-1]))
    colours = np.stack([vertices.get(n, np.zeros(len(points))) for n in _COLOURS], axis=1)
    count = _common((colours[1:] != colours[:-1]).any(axis=1))
    if not count or _hits(gaps, count) < SHARE:
        count = _common(gaps)
    straight = np.einsum("ni,ni->n", steps[1:], steps[:-1]) > 0.5 * step[1:] * step[:-1]
    if not count or straight.mean() < SHARE:
        raise StrandFileError(
            "the strands' ends are unknown: vertices need a strand_id, one colour for each strand, "
            "edges, or the same number of points for each strand"
        )
    ends = np.zeros(len(points) - 1, bool)
    ends[count - 1 :: count] = True
    return _split(points, ends, radius)


def write_ply_strands(path: Path, strands: Strands) -> None:
    """Write vertices x, y, z, the `radius` of each, and edges along the strands, as Blender and
    MeshLab show them."""
    first = np.setdiff1d(np.arange(len(strands.points)), strands.offsets[1:] - 1)
    vertices = np.empty((len(strands.points), 4), "<f4")
    vertices[:, :3], vertices[:, 3] = strands.points, strands.radius
    numbers = "".join(f"property float {n}\n" for n in ("x", "y", "z", "radius"))
    head = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n{numbers}"
        f"element edge {len(first)}\nproperty int vertex1\nproperty int vertex2\nend_header\n"
    )
    with writing(path) as temporary:
        edges = np.stack([first, first + 1], axis=1).astype("<i4")
        temporary.write_bytes(head.encode() + vertices.tobytes() + edges.tobytes())


def _joined(edges: dict[str, NDArray[Any]], vertices: int) -> Bools:
    """Whether an edge joins each vertex and the next `(N - 1,)`."""
    if not {"vertex1", "vertex2"} <= set(edges):
        raise StrandFileError(f"an edge has {list(edges)}, expected vertex1 and vertex2")
    first, second = (edges[f"vertex{k}"].astype(np.int64) for k in (1, 2))
    low = np.minimum(first, second)
    if (np.abs(second - first) != 1).any() or (low < 0).any() or (low > vertices - 2).any():
        raise StrandFileError("an edge joins vertices that do not follow each other")
    joined = np.zeros(vertices - 1, bool)
    joined[low] = True
    return joined


def _hits(ends: Bools, count: int) -> float:
    """Share of `ends` that lie between strands of `count` points."""
    return float(((np.flatnonzero(ends) + 1) % count == 0).mean()) if ends.any() else 1.0


def _common(ends: Bools) -> int:
    """The points of each strand, if `ends` are mostly theirs and theirs are mostly among `ends`."""
    vertices, best, score = len(ends) + 1, 0, SHARE
    if not ends.any():
        return vertices
    small = np.arange(1, int(vertices**0.5) + 1)
    small = small[vertices % small == 0]
    for count in sorted({*small.tolist(), *(vertices // small).tolist()} - {1, 2, vertices}):
        hits = _hits(ends, count)
        share = hits * ends.sum() / (vertices / count - 1)
        if hits * share > score:
            best, score = count, hits * share
    return best


def _split(points: Floats, ends: Bools, radius: float | Floats | None) -> Strands:
    """Strands that end at the points `ends (N - 1,)`, and at the last."""
    offsets = np.concatenate([[0], np.flatnonzero(ends) + 1, [len(points)]])
    return Strands(points, offsets) if radius is None else Strands(points, offsets, radius)

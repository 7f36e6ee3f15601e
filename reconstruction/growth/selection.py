"""Selection of strands by the measured lines that each covers."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from reconstruction.arrays import AnyFloats, Array, Bools, Ints
from reconstruction.geometry.strands import Resampling, Strands
from reconstruction.growth.lines import BLOCK, GUESSED, Lines, Surfaces
from reconstruction.tangents.line_evidence import half_sphere, visible_from

GUESS = 0.05  # coverage of a cell without measurement; 1 with the best
HEADINGS = 24  # directions of a coverage cell


def without_exposed_ends(strands: Strands, lines: Lines, surfaces: Surfaces) -> Strands:
    """Strands that end where no line supports them any more although cameras see them.

    A strand without any supported point stays as it is.
    """
    if not surfaces:
        return strands
    support = lines.support(strands.points, strands.tangents())
    count = np.diff(strands.offsets)
    place = np.arange(len(support)) - np.repeat(strands.offsets[:-1], count)
    ends = (support < GUESSED) & exposed(strands.points, surfaces, lines.width)
    last = np.maximum.reduceat(np.where(ends, -1, place), strands.offsets[:-1])
    last = np.where(last < 1, count - 1, last)  # a strand has two points
    keep = place <= np.repeat(last, count)
    offsets = np.append(0, np.cumsum(last + 1))
    radius = strands.radius[keep] if isinstance(strands.radius, np.ndarray) else strands.radius
    return Strands(strands.points[keep], offsets, radius)


def exposed(points: AnyFloats, surfaces: Surfaces, width: float) -> Bools:
    """Whether some camera sees each of `points (N, 3)`: at most `width` behind its surface."""
    out = np.zeros(len(points), bool)
    for camera, surface in surfaces:
        out |= visible_from(camera, surface, points, width)
    return out


def select_by_coverage(
    strands: Strands, lines: Lines, marginal_coverage: float, surfaces: Surfaces = ()
) -> Bools:
    """Which strands `(S,)` add at least `marginal_coverage` per width of the lines.

    A cell of a width and some 15 degrees is covered by the support of the best strand in it, and
    by `GUESS` where no camera sees it. Lazy greedy selection: a strand's marginal coverage only
    falls.
    """
    if not len(strands):
        return np.zeros(0, bool)
    count = np.diff(Resampling(strands, lines.width).offsets)
    own = [mean for part in _parts(strands, count) for mean in _by_cell(part, lines, surfaces)]
    cells, number = np.unique(np.concatenate([cell for cell, _ in own]), return_inverse=True)
    numbers = np.split(number.ravel(), np.cumsum([len(cell) for cell, _ in own])[:-1])
    own = [(cell, value) for cell, (_, value) in zip(numbers, own, strict=True)]
    best = np.zeros(len(cells))

    def gain(i: int) -> float:
        cell, there = own[i]
        return float(np.maximum(there - best[cell], 0).sum()) / float(count[i])

    heap = [(-gain(i), i) for i in range(len(own))]
    heapq.heapify(heap)
    kept = np.zeros(len(own), bool)
    while heap:
        _, i = heapq.heappop(heap)
        now = gain(i)
        if now < marginal_coverage:
            continue
        if heap and now < -heap[0][0]:
            heapq.heappush(heap, (-now, i))
            continue
        kept[i] = True
        cell, there = own[i]
        best[cell] = np.maximum(best[cell], there)
    return kept


def _parts(strands: Strands, count: Ints) -> Iterator[Strands]:
    """Neighbouring strands with about `BLOCK` points, of `count (S,)` points each."""
    part = np.cumsum(count) // BLOCK
    for k in np.unique(part):
        yield strands.subset(part == k)


def _by_cell(strands: Strands, lines: Lines, surfaces: Surfaces) -> list[tuple[Ints, Array]]:
    """The cells that each strand lies in, and their coverage by it."""
    dense = strands.resampled(lines.width)
    tangents = dense.tangents()
    hidden = ~exposed(dense.points, surfaces, lines.width)
    value = GUESS * hidden + lines.support(dense.points, tangents)
    cells = _cells(dense.points, tangents, lines.width)
    return [_mean_by(cells[a:b], value[a:b]) for a, b in pairwise(dense.offsets)]


def _cells(points: AnyFloats, tangents: AnyFloats, width: float) -> Ints:
    """Numbers `(N,)` of the cells of place and direction that points lie in, up to 2^17 widths from
    the origin."""
    heading = np.abs(tangents @ half_sphere(HEADINGS).T.astype(np.float32)).argmax(axis=1)
    x, y, z = np.floor(points / width).astype(np.int64).T + (1 << 17)
    return np.asarray(((x << 36 | y << 18 | z) * HEADINGS) + heading)


def _mean_by(cells: Ints, value: Array) -> tuple[Ints, Array]:
    """The different ones of `cells (N,)` and the mean of `value (N,)` in each."""
    cell, member, count = np.unique(cells, return_inverse=True, return_counts=True)
    return cell, np.bincount(member.ravel(), value, len(cell)) / count

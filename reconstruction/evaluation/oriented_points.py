"""Strands as points with tangents at equal steps, generated in blocks of whole strands.

100,000 strands of 20 cm are 20 million points at 1 mm; blocks bound the memory.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Protocol

import numpy as np
from scipy.spatial import cKDTree

from reconstruction.arrays import Array, Bools, Floats, Ints
from reconstruction.geometry.strands import Resampling, Strands, unit_or_zero

PointTest = Callable[[Floats], Bools]
"""Which of points `(N, 3)` are visible, `(N,)`; `Visibility` is one."""

STEP = 1e-3  # metres between the points
BLOCK = 250_000  # points of a block, more for a longer strand
MOST_POINTS = 300_000_000
"""Four times the points of 150,000 strands of 0.5 m: more suggests another unit."""

MOST_OF_ONE = 1_000_000  # points of one strand
MOST_PAIRS = 4_000_000
"""Neighbour pairs processed together; bounds the memory."""

OVERSAMPLING = 5  # points tested per requested visible point


@dataclass(frozen=True)
class Threshold:
    """A point matches within `distance` metres and under `angle` degrees."""

    distance: float
    angle: float

    @property
    def name(self) -> str:
        """For example `1mm_10deg`."""
        return f"{self.distance * 1e3:g}mm_{self.angle:g}deg"


# ascending in both: a match at one is a match at all that follow
THRESHOLDS = (Threshold(1e-3, 10.0), Threshold(2e-3, 20.0), Threshold(3e-3, 30.0))


@dataclass(frozen=True, eq=False)
class Block:
    """`points (N, 3)`, the `strand (N,)` of each, and its unit `tangents (N, 3)`, root to tip.

    Where a strand has no length, the tangent is 0.
    """

    points: Floats
    tangents: Floats
    strand: Ints

    @cached_property
    def tree(self) -> cKDTree:
        """A tree of the points."""
        return cKDTree(self.points, balanced_tree=False, compact_nodes=False)


@dataclass(frozen=True, eq=False)
class Drawn(Block):
    """Points to score; `complete` if they are all points."""

    complete: bool


class BlockConsumer(Protocol):
    """Accumulates results over all blocks of a set."""

    def look(self, block: Block) -> None:
        """Process one block."""


def require_hair(strands: Strands) -> None:
    """Raise `ValueError` for strands too long to be hair in metres."""
    lengths = strands.lengths()
    if (together := float(lengths.sum())) > MOST_POINTS * STEP:
        raise ValueError(
            f"the {len(strands)} strands have a total length of {together / 1e3:,.0f} km, limit "
            f"{MOST_POINTS * STEP / 1e3:,.0f} km: check that they are in metres"
        )
    if (longest := float(lengths.max(initial=0))) > MOST_OF_ONE * STEP:
        raise ValueError(
            f"the longest strand is {longest:,.0f} m long, limit {MOST_OF_ONE * STEP:,.0f} m: "
            "check that strands are in metres"
        )


class OrientedPoints:
    """`strands` as `count` points, `STEP` apart.

    Raises as `require_hair` does.
    """

    def __init__(self, strands: Strands) -> None:
        require_hair(strands)
        self._at = Resampling(strands, STEP)
        self.offsets = self._at.offsets
        self.count = int(self.offsets[-1])
        ends = [0]
        while ends[-1] < len(strands):
            fits = np.searchsorted(self.offsets, self.offsets[ends[-1]] + BLOCK, side="right") - 1
            ends.append(max(int(fits), ends[-1] + 1))
        self._ends = ends
        self._only: Block | None = None

    def blocks(self) -> Iterator[Block]:
        """All points by strand; a single block is cached."""
        if self._only is not None:
            yield self._only
            return
        for first, last in pairwise(self._ends):
            strand = np.arange(first, last)
            index = np.arange(self.offsets[first], self.offsets[last])
            owner = np.repeat(strand, np.diff(self.offsets[first : last + 1]))
            points, _ = self._at(index)
            before, after = (beside - index[0] for beside in self._beside(index, owner))
            block = Block(points, _directions(points[before], points[after]), owner)
            if len(self._ends) == 2:
                self._only = block
            yield block

    def feed(self, *consumers: BlockConsumer) -> None:
        """Pass every block to all `consumers`."""
        for block in self.blocks():
            for consumer in consumers:
                consumer.look(block)

    def draw(
        self, samples: int | None, rng: np.random.Generator, visible: PointTest | None = None
    ) -> Drawn:
        """At most `samples` random points, or random `visible` points."""
        if samples is None:
            samples = self.count
        tried = self.count if visible is None else min(self.count, OVERSAMPLING * samples)
        chosen = np.arange(self.count)
        if tried < self.count:
            chosen = np.sort(rng.choice(self.count, tried, replace=False))
        if visible is not None:
            chosen = chosen[visible(self._at(chosen)[0])]
        complete = tried == self.count and len(chosen) <= samples
        if len(chosen) > samples:
            chosen = np.sort(rng.choice(chosen, samples, replace=False))
        block = self._make(chosen, np.searchsorted(self.offsets, chosen, side="right") - 1)
        return Drawn(block.points, block.tangents, block.strand, complete)

    def of_strands(self, which: Ints) -> Block:
        """All points of the strands `which (M,)`, in that order."""
        counts = np.diff(self.offsets)[which]
        strand = np.repeat(which, counts)
        place = np.arange(len(strand)) - np.repeat(np.cumsum(counts) - counts, counts)
        return self._make(self.offsets[strand] + place, strand)

    def _make(self, index: Ints, strand: Ints) -> Block:
        before, after = self._beside(index, strand)
        tangents = _directions(self._at(before)[0], self._at(after)[0])
        return Block(self._at(index)[0], tangents, strand)

    def _beside(self, index: Ints, strand: Ints) -> tuple[Ints, Ints]:
        """The points before and after each on its strand, or the end itself."""
        first, last = self.offsets[strand], self.offsets[strand + 1] - 1
        return np.maximum(index - 1, first), np.minimum(index + 1, last)


def _directions(before: Floats, after: Floats) -> Floats:
    """Unit vectors `(N, 3)`, 0 for coincident points."""
    return unit_or_zero(after.astype(float) - before).astype(np.float32)


def near_pairs(points: Floats, other: Block, reach: float) -> Iterator[tuple[Ints, Ints, Array]]:
    """Indices `(N,)`, `(N,)` of points and points of `other` at most `reach` metres apart, and the
    distances `(N,)`.

    In parts of about `MOST_PAIRS`, with all pairs of a point in one part.
    """
    if len(points) == 0:
        return
    near = other.tree.query_ball_point(points, reach, return_length=True, workers=-1)
    part = np.cumsum(near) // MOST_PAIRS
    for k in np.unique(part):
        chunk = np.flatnonzero((part == k) & (near > 0))
        if len(chunk):
            tree = cKDTree(points[chunk])
            pairs = tree.sparse_distance_matrix(other.tree, reach, output_type="ndarray")
            yield chunk[pairs["i"]], pairs["j"], pairs["v"]

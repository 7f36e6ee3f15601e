"""Strands of the visible surface, traced through the measured lines without a voxel field.

A strand follows the lines around it and moves to their centre at every step, as in the mean shift
on lines of Sun et al. 2021 §4.3. A voxel field would blur hair that turns within millimetres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from reconstruction.arrays import Array, Bools, Floats, Ints
from reconstruction.geometry.strands import smoothed
from reconstruction.tangents.estimate import Measured

# Lengths as multiples of how far lines are apart.
BANDWIDTH = 0.8
NEIGHBOURS = 16
ANGLE_DEG, SAME_DEG = 35.0, 20.0
PULL = 0.6
LEAST_SUPPORT = 0.5

# Strands traced at once, at most one per so many lines: strands that start together are unaware of
# the lines that the others will consume.
_TOGETHER, _LINES_EACH = 500, 200


@dataclass(frozen=True)
class SurfaceOptions:
    """How strands are traced through measured lines; lengths as multiples of `apart`, metres.

    `apart` is about the distance between lines. At most `NEIGHBOURS` lines within 2.5 `BANDWIDTH`s
    and `ANGLE_DEG` guide a strand; every `step` it moves `PULL` of the way to their mean. It ends
    where their distance-weighted confidences sum to less than `LEAST_SUPPORT`, and at `longest`
    metres. Lines closer than `spacing` to its points and parallel within `SAME_DEG` start no other;
    strands shorter than `shortest` are dropped, the others smoothed by a Gaussian of `smooth`.
    """

    apart: float = 1.25e-3
    step: float = 0.7
    spacing: float = 0.6
    longest: float = 0.3
    shortest: float = 2.4
    smooth: float = 1.0


class LineCloud:
    """Measured lines, looked up by place and direction; `consumed (N,)` start no strand."""

    def __init__(self, lines: Measured, options: SurfaceOptions) -> None:
        self._lines = lines
        self._options = options
        self._bandwidth = BANDWIDTH * options.apart
        self.step = options.step * options.apart
        self.consumed = np.zeros(len(lines.points), bool)
        self._tree = cKDTree(lines.points, balanced_tree=False, compact_nodes=False)

    def sample(self, p: Array, along: Array) -> tuple[Array, Array, Array]:
        """Mean directions `(N, 3)`, offsets `(N, 3)` to the lines across them, support `(N,)`.

        Over the lines around `p (N, 3)` within `ANGLE_DEG` of `along (N, 3)`, which is returned if
        there are none. Adjacent parallel lines are consumed if the support suffices.
        """
        k = min(NEIGHBOURS, len(self._lines.points))
        distance, index = self._tree.query(
            p, k=np.arange(1, k + 1), distance_upper_bound=2.5 * self._bandwidth
        )
        there = np.isfinite(distance)
        index = np.where(there, index, 0)
        d = self._lines.directions[index]
        cosine = np.einsum("nki,ni->nk", d, along)
        there &= np.abs(cosine) >= np.cos(np.radians(ANGLE_DEG))
        near = np.exp(-(np.where(there, distance, 0) ** 2) / (2 * self._bandwidth**2))
        weight = np.where(there, near * self._lines.confidence[index], 0.0)
        support = weight.sum(axis=1)
        spacing = self._options.spacing * self._options.apart
        beside = (distance <= spacing) & (support >= LEAST_SUPPORT)[:, None]
        mean = np.einsum("nk,nki->ni", weight * np.sign(cosine), d)
        length = np.linalg.norm(mean, axis=1, keepdims=True)
        mean = np.where(length > 1e-12, mean / np.maximum(length, 1e-12), along)
        middle = np.einsum("nk,nki->ni", weight, self._lines.points[index] - p[:, None])
        middle /= np.maximum(support, 1e-12)[:, None]
        middle -= np.einsum("ni,ni->n", middle, mean)[:, None] * mean
        row, column = np.nonzero(beside)
        alike = np.abs(np.einsum("ni,ni->n", d[row, column], mean[row]))
        self.consumed[index[row, column][alike >= np.cos(np.radians(SAME_DEG))]] = True
        return mean, middle, support


class _Pool:
    """Up to `size` strands in progress; ways k and `size` + k are the two directions of one."""

    def __init__(self, cloud: LineCloud, options: SurfaceOptions, size: int) -> None:
        self._cloud, self._size, ways = cloud, size, 2 * size
        self._most = int(options.longest / cloud.step)
        self._rows = np.zeros((ways, self._most + 1, 3))
        self._counts = np.zeros(ways, np.int64)
        self._goes = np.zeros(ways, bool)
        self._p, self._d = np.zeros((ways, 3)), np.zeros((ways, 3))
        self.busy = np.zeros(size, bool)

    def begin(self, starts: Array, along: Array) -> None:
        """Start at `starts (N, 3)` along `along (N, 3)`; at least N slots must be free."""
        k = np.flatnonzero(~self.busy)[: len(starts)]
        self.busy[k] = True
        for ways, sign in ((k, 1.0), (k + self._size, -1.0)):
            self._p[ways], self._d[ways] = starts, sign * along
            self._rows[ways, 0] = starts
            self._counts[ways] = 1
            self._goes[ways] = self._most > 0

    def step(self) -> list[Array]:
        """Advance all ways by one step; returns the paths `(N, 3)` that ended on both sides."""
        ways = np.flatnonzero(self._goes)
        mean, middle, support = self._cloud.sample(self._p[ways], self._d[ways])
        good = support >= LEAST_SUPPORT
        self._goes[ways[~good]] = False
        ways, d = ways[good], mean[good]
        self._d[ways] = d
        self._p[ways] += self._cloud.step * d + PULL * middle[good]
        self._rows[ways, self._counts[ways]] = self._p[ways]
        self._counts[ways] += 1
        self._goes[ways[self._counts[ways] > self._most]] = False
        ahead, back = np.split(self._goes, 2)
        ended = np.flatnonzero(self.busy & ~ahead & ~back)
        self.busy[ended] = False
        both = ((self._way(self._size + k), self._way(k)) for k in ended.tolist())
        return [np.concatenate([first[:0:-1], then]) for first, then in both]

    def _way(self, k: int) -> Array:
        return self._rows[k, : self._counts[k]]


def surface_strands(
    lines: Measured, options: SurfaceOptions = SurfaceOptions(), *, seed: int = 0
) -> list[Floats]:
    """Polylines `(N, 3)` through measured lines, both ways from unconsumed ones in random order."""
    if not len(lines.points):
        return []
    cloud = LineCloud(lines, options)
    pool = _Pool(cloud, options, min(_TOGETHER, -(-len(lines.points) // _LINES_EACH)))
    order = np.random.default_rng(seed).permutation(len(lines.points))
    found: list[Array] = []
    while len(order) or pool.busy.any():
        free = int((~pool.busy).sum())
        if free and len(order):
            chosen, order = _next(order, cloud.consumed, free)
            cloud.consumed[chosen] = True
            pool.begin(lines.points[chosen], lines.directions[chosen])
        found += [p for p in pool.step() if (len(p) - 1) * options.step >= options.shortest]
    return [p.astype(np.float32) for p in smoothed(found, options.smooth * options.apart)]


def _next(order: Ints, consumed: Bools, count: int) -> tuple[Ints, Ints]:
    """The first `count` lines of `order (N,)` that are not `consumed`, and the rest of `order`."""
    chosen: list[Ints] = []
    while count > 0 and len(order):
        some, order = order[:count], order[count:]
        chosen.append(some[~consumed[some]])
        count -= len(chosen[-1])
    return np.concatenate(chosen or [order]), order

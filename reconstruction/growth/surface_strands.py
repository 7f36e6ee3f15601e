"""Strands of the seen surface, traced through the measured lines themselves.

A voxel field blurs what it is given by a voxel; where hair turns within millimetres that is most of
what was measured. Here a strand follows the lines around it and is drawn to their middle at every
step, as in the mean shift on lines of Sun et al. 2021 §4.3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from reconstruction.arrays import Array, Bools, Floats
from reconstruction.geometry.strands import smoothed
from reconstruction.tangents.estimate import Measured

# Lengths as multiples of how far lines are apart.
BANDWIDTH = 0.8
NEIGHBOURS = 16
ANGLE_DEG, SAME_DEG = 35.0, 20.0
PULL = 0.6
LEAST_SUPPORT = 0.5
SPACING = 0.4

_BATCH = 2000


@dataclass(frozen=True)
class SurfaceOptions:
    """How strands are traced through measured lines; lengths as multiples of `apart`, metres.

    `apart` is about how far the lines are from one another. Those within 2.5 `BANDWIDTH`s that
    turn by at most `ANGLE_DEG` lead a strand, at most `NEIGHBOURS` of them; every `step` it moves
    `PULL` of the way to their middle. It ends where their confidences, each less the further
    away, add up to less than `LEAST_SUPPORT`, and at `longest` metres. Lines closer than `SPACING`
    to a strand that runs along them within `SAME_DEG` start no other; strands shorter than
    `shortest` are not kept, the others are smoothed along their length by a Gaussian of `smooth`.
    """

    apart: float = 1.25e-3
    step: float = 0.4
    longest: float = 0.3
    shortest: float = 2.4
    smooth: float = 1.0


class LineCloud:
    """Measured lines that are looked up by place and direction."""

    def __init__(self, lines: Measured, options: SurfaceOptions) -> None:
        self._lines = lines
        self._options = options
        self._bandwidth = BANDWIDTH * options.apart
        self.step = options.step * options.apart
        self.tree = cKDTree(lines.points, balanced_tree=False, compact_nodes=False)

    def sample(self, p: Array, along: Array) -> tuple[Array, Array, Array]:
        """Unit directions `(N, 3)`, ways to the lines' middle `(N, 3)` across them, support `(N,)`.

        Of the lines around `p (N, 3)` that run as `along (N, 3)` does; that itself where none does.
        """
        k = min(NEIGHBOURS, len(self._lines.points))
        distance, index = self.tree.query(
            p, k=np.arange(1, k + 1), distance_upper_bound=2.5 * self._bandwidth, workers=-1
        )
        there = np.isfinite(distance)
        index = np.where(there, index, 0)
        d = self._lines.directions[index]
        cosine = np.einsum("nki,ni->nk", d, along)
        there &= np.abs(cosine) >= np.cos(np.radians(ANGLE_DEG))
        near = np.exp(-(np.where(there, distance, 0) ** 2) / (2 * self._bandwidth**2))
        weight = np.where(there, near * self._lines.confidence[index], 0.0)
        support = weight.sum(axis=1)
        mean = np.einsum("nk,nki->ni", weight * np.sign(cosine), d)
        length = np.linalg.norm(mean, axis=1, keepdims=True)
        mean = np.where(length > 1e-12, mean / np.maximum(length, 1e-12), along)
        middle = np.einsum("nk,nki->ni", weight, self._lines.points[index] - p[:, None])
        middle /= np.maximum(support, 1e-12)[:, None]
        middle -= np.einsum("ni,ni->n", middle, mean)[:, None] * mean
        return mean, middle, support

    def trace(self, starts: Array, along: Array) -> list[Array]:
        """Paths `(N, 3)` from `starts (N, 3)`, setting out along `along (N, 3)`."""
        p, d = starts.copy(), along.copy()
        active = np.arange(len(p))
        rows, counts = [p.copy()], np.ones(len(p), np.int64)
        for _ in range(int(self._options.longest / self.step)):
            mean, middle, support = self.sample(p, d)
            good = support >= LEAST_SUPPORT
            active, d = active[good], mean[good]
            if not len(active):
                break
            p = p[good] + self.step * d + PULL * middle[good]
            row = np.zeros_like(starts)
            row[active] = p
            rows.append(row)
            counts[active] += 1
        columns = np.stack(rows, axis=1)
        return [columns[i, :n] for i, n in enumerate(counts)]


def surface_strands(
    lines: Measured, options: SurfaceOptions = SurfaceOptions(), *, seed: int = 0
) -> list[Floats]:
    """Polylines `(N, 3)` through measured lines, both ways from lines that none passes yet.

    Lines are taken two thousand at a time in an order drawn by `seed`.
    """
    if not len(lines.points):
        return []
    cloud = LineCloud(lines, options)
    order = np.random.default_rng(seed).permutation(len(lines.points))
    spent = np.zeros(len(order), bool)
    out: list[Floats] = []
    while len(order := order[~spent[order]]):
        chosen = order[:_BATCH]
        spent[chosen] = True
        p, d = lines.points[chosen], lines.directions[chosen]
        ways = cloud.trace(np.tile(p, (2, 1)), np.concatenate([d, -d]))
        paths = [
            np.concatenate([back[:0:-1], ahead])
            for ahead, back in zip(ways[: len(chosen)], ways[len(chosen) :], strict=True)
        ]
        paths = [p for p in paths if (len(p) - 1) * options.step >= options.shortest]
        if paths:
            _spend(cloud, lines, paths, spent, options)
        sigma = options.smooth * options.apart
        out += [smoothed(path, sigma).astype(np.float32) for path in paths]
    return out


def _spend(
    cloud: LineCloud, lines: Measured, paths: list[Array], spent: Bools, options: SurfaceOptions
) -> None:
    """Mark the lines that `paths` pass along."""
    points = np.concatenate(paths)
    tangents = np.concatenate([np.gradient(path, axis=0) for path in paths])
    tangents /= np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-12)
    near = cloud.tree.query_ball_point(points, SPACING * options.apart, workers=-1)
    owner = np.repeat(np.arange(len(points)), [len(n) for n in near])
    line = np.fromiter((j for n in near for j in n), np.int64, len(owner))
    cosine = np.einsum("ni,ni->n", lines.directions[line], tangents[owner])
    spent[line[np.abs(cosine) >= np.cos(np.radians(SAME_DEG))]] = True

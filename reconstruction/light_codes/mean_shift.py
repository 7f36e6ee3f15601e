"""Mean shift on a cloud of line segments: lines slide together sideways (Sun §4.3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.float64]

_TOGETHER = 100_000


@dataclass(frozen=True)
class MeanShiftOptions:
    """`bandwidth` metres across the lines, `neighbours` looked at, `angle_deg` between lines."""

    bandwidth: float = 4e-4
    neighbours: int = 24
    angle_deg: float = 20.0
    rounds: int = 4


def mean_shift(
    points: Array,
    directions: Array,
    weights: Array,
    options: MeanShiftOptions = MeanShiftOptions(),
) -> tuple[Array, Array]:
    """Points `(N, 3)` and unit directions `(N, 3)` after they moved to the middle of their lines.

    A point moves across its own line only, to the mean of its neighbours in space whose lines are
    alike, by a Gaussian of the distance and their `weights (N,)`; its direction becomes the main
    axis of theirs. Neighbours come from a KD-tree.
    """
    p, d = np.asarray(points, float).copy(), np.asarray(directions, float).copy()
    w = np.asarray(weights, float)
    if len(p) < 2:
        return p, d
    count = min(options.neighbours, len(p))
    least = np.cos(np.radians(options.angle_deg))
    for _ in range(options.rounds):
        tree = cKDTree(p, balanced_tree=False, compact_nodes=False)
        q, e = np.empty_like(p), np.empty_like(d)
        for first in range(0, len(p), _TOGETHER):
            part = slice(first, first + _TOGETHER)
            q[part], e[part] = _shift(tree, p, d, w, part, count, least, options.bandwidth)
        p, d = q, e
    return p, d


def _shift(
    tree: cKDTree,
    p: Array,
    d: Array,
    w: Array,
    part: slice,
    count: int,
    least: float,
    bandwidth: float,
) -> tuple[Array, Array]:
    reach = 3 * bandwidth
    _, index = tree.query(p[part], k=np.arange(1, count + 1), distance_upper_bound=reach)
    there = index < len(p)
    index = np.where(there, index, 0)
    apart = p[index] - p[part, None]
    along = np.einsum("nki,ni->nk", apart, d[part])
    across = apart - along[..., None] * d[part, None]
    cosine = np.einsum("nki,ni->nk", d[index], d[part])
    near = np.exp(-(apart**2).sum(axis=-1) / (2 * bandwidth**2))
    weight = np.where(there & (np.abs(cosine) >= least), near * w[index], 0.0)
    total = np.maximum(weight.sum(axis=1), 1e-300)[:, None]
    q = p[part] + np.einsum("nk,nki->ni", weight, across) / total
    e = np.einsum("nk,nki->ni", weight * np.sign(cosine), d[index])
    norm = np.linalg.norm(e, axis=1, keepdims=True)
    return q, np.where(norm > 1e-12, e / np.maximum(norm, 1e-12), d[part])


def thinned_lines(
    points: Array, directions: Array, weights: Array, spacing: float
) -> tuple[Array, Array, Array]:
    """One line for each cell of `spacing` metres and each of its main directions.

    Lines of a cell are averaged with those whose largest component is the same: points `(M, 3)`,
    directions `(M, 3)` and summed weights `(M,)`.
    """
    if not len(points):
        return points, directions, weights
    axis = np.abs(directions).argmax(axis=1)
    cell = np.floor(points / spacing).astype(np.int64)
    sign = np.sign(directions[np.arange(len(axis)), axis])
    _, member = np.unique(np.column_stack([cell, axis]), axis=0, return_inverse=True)
    member = member.ravel()
    count = int(member.max()) + 1
    total: Array = np.bincount(member, weights, count).astype(float)

    def mean(values: Array) -> Array:
        sums = [np.bincount(member, weights * v, count) for v in values.T]
        return np.stack(sums, axis=1) / np.maximum(total, 1e-300)[:, None]

    d = mean(directions * sign[:, None])
    return mean(points), d / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-12), total

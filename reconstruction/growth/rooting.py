"""Strands that reach the scalp: loose ones rise from it, or join a neighbour on its way."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from reconstruction.arrays import Array, Floats
from reconstruction.head.scalp import Scalp

_STRIDE = 4
"""Every fourth point of a strand stands for it in the search: the growth's step is short."""

_RISE = 1e-3  # metres between the points of a way from the scalp

_NEAR, _HIGHEST = 8e-3, 40e-3
"""Metres above the scalp: up to where an end is led down at once, and up to where at all."""

_REACHES = (3e-3, 5e-3, 8e-3, 8e-3, 12e-3, 12e-3, 20e-3)
"""Metres within which a neighbour is looked for, round by round."""

_Loose = tuple[Floats, Array]
"""A polyline, and the heights `(2,)` of its ends above the scalp."""

_LEAST_COSINE = np.cos(np.radians(45.0))
"""Of the turn from a loose strand into the neighbour that continues it."""


@dataclass(frozen=True)
class Rooted:
    """Strands that start on the scalp, and how loose ones got there.

    `to_scalp` were led to the scalp from their lower end, `joined` run as a rooted neighbour does,
    `dropped` found neither.
    """

    strands: list[Floats]
    to_scalp: int
    joined: int
    dropped: int


def root_all(rooted: list[Floats], loose: list[Floats], scalp: Scalp) -> Rooted:
    """Give every loose polyline `(N, 3)` a root; its direction in space is not changed.

    An end within 8 mm of the scalp is led to it. Any other goes on as the nearest rooted strand
    that continues it within 45 degrees: where the scalp is at most 40 mm below, down through the
    hair to it, which hides what nobody measured; else beside that strand, keeping a distance that
    fades towards its root. Strands that were joined carry others in the next round, which looks
    further. What finds none is led down from its lower end, if the scalp is near enough.
    """
    strands = list(rooted)
    if not loose:
        return Rooted(strands, 0, 0, 0)
    below = _Below(scalp)
    waiting: list[_Loose] = []
    for path, h in zip(loose, below.heights(_ends(loose)), strict=True):
        if h.min() > _NEAR:
            waiting.append((path, h))
        else:
            strands.append(below.lead_lower(path, h))
    to_scalp = len(strands) - len(rooted)
    joined = 0
    for reach in _REACHES:
        if not waiting or not strands:
            break
        attached, waiting = _join_round(strands, waiting, reach, below)
        joined += len(attached)
        strands += attached
    led = [below.lead_lower(path, h) for path, h in waiting if h.min() <= _HIGHEST]
    return Rooted(strands + led, to_scalp + len(led), joined, len(waiting) - len(led))


class _Below:
    """Ways to the scalp under a strand."""

    def __init__(self, scalp: Scalp) -> None:
        self._scalp = scalp
        self._tree = cKDTree(scalp.points)

    def heights(self, points: Array) -> Array:
        """Distance `(...)` of `points (..., 3)` to the scalp, metres."""
        return np.asarray(self._tree.query(points)[0])

    def lead_lower(self, path: Floats, heights: Array) -> Floats:
        """`lead` from the lower end; `heights (2,)` are those of both."""
        return self.lead(path if heights[0] <= heights[1] else path[::-1])

    def lead(self, path: Floats) -> Floats:
        """The path with a way from the scalp before it: out along its normal, then into the path.

        It rises at about 45 degrees, a cubic in Hermite's form.
        """
        p = path[0].astype(float)
        along = path[min(_STRIDE, len(path) - 1)] - p
        along /= max(float(np.linalg.norm(along)), 1e-12)
        height, _ = self._tree.query(p)
        _, k = self._tree.query(p - height * along)
        root, normal = self._scalp.points[k], self._scalp.normals[k]
        length = float(np.linalg.norm(p - root))
        if length < 5e-4:
            return path
        u = np.linspace(0, 1, max(2, int(length / _RISE) + 1))[:-1, None]
        start, out = (2 * u - 3) * u * u + 1, ((u - 2) * u + 1) * u
        end, into = (3 - 2 * u) * u * u, (u - 1) * u * u
        way = start * root + end * p + length * (out * normal + into * along)
        return np.concatenate([way.astype(np.float32), path])


def _ends(paths: list[Floats]) -> Array:
    """First and last points `(N, 2, 3)`."""
    return np.stack([[p[0] for p in paths], [p[-1] for p in paths]], axis=1).astype(float)


def _join_round(
    strands: list[Floats], loose: list[_Loose], reach: float, below: _Below
) -> tuple[list[Floats], list[_Loose]]:
    """The loose polylines that find a rooted neighbour now, rooted, and those that do not."""
    points = np.concatenate(strands)
    counts = np.array([len(s) for s in strands])
    first = np.concatenate([[0], np.cumsum(counts)[:-1]])
    owner = np.repeat(np.arange(len(strands)), counts)
    place = np.arange(len(points)) - first[owner]
    some = np.flatnonzero((place > 0) & (place % _STRIDE == 0))  # nothing goes on below a root
    if not len(some):
        return [], loose
    rootward = points[some - 1] - points[some]
    rootward /= np.maximum(np.linalg.norm(rootward, axis=1, keepdims=True), 1e-12)
    tree = cKDTree(points[some], balanced_tree=False, compact_nodes=False)
    paths = [path for path, _ in loose]
    ends = _ends(paths).reshape(-1, 3)
    before = [[p[min(4, len(p) - 1)] for p in paths], [p[-min(5, len(p))] for p in paths]]
    out = ends - np.stack(before, axis=1).reshape(-1, 3)
    out = out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-12)
    distance, index = tree.query(ends, k=np.arange(1, 17), distance_upper_bound=reach)
    found = np.isfinite(distance)
    index = np.where(found, index, 0)
    cosine = np.einsum("nkd,nd->nk", rootward[index], out)
    cost = np.where(found & (cosine >= _LEAST_COSINE), distance + reach * (1 - cosine), np.inf)
    pick = cost.argmin(axis=1)
    cost = cost[np.arange(len(ends)), pick].reshape(-1, 2)
    target = some[index[np.arange(len(ends)), pick]].reshape(-1, 2)
    attached, left = [], []
    for (path, h), c, t in zip(loose, cost, target, strict=True):
        if not np.isfinite(c.min()):
            left.append((path, h))
            continue
        end = int(c.argmin())
        path = path if end == 0 else path[::-1]
        if h[end] <= _HIGHEST:
            attached.append(below.lead(path))
            continue
        guide = points[first[owner[t[end]]] : t[end] + 1].astype(float)
        attached.append(_beside(guide, path))
    return attached, left


def _beside(guide: Array, path: Floats) -> Floats:
    """The path with a way to the guide's root before it, parallel to the guide where they meet."""
    offset = path[0] - guide[-1]
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(guide, axis=0), axis=1))])
    share = arc / max(arc[-1], 1e-12)
    fade = share * share * (3 - 2 * share)
    way = guide + fade[:, None] * offset
    # the guide's last point falls on the path's first by construction
    return np.concatenate([way[:-1].astype(np.float32), path])

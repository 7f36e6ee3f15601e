"""Rooting: loose strands are connected to the scalp, or follow a rooted neighbour to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from reconstruction.arrays import Array, Floats
from reconstruction.head.scalp import Scalp

_STRIDE = 4
"""Every fourth point of a strand takes part in the search."""

_RISE = 1e-3  # metres between the points of a connection to the scalp

_NEAR, _HIGHEST = 8e-3, 40e-3
"""Metres above the scalp up to which an end is connected at once, and at all."""

_REACHES = (3e-3, 5e-3, 8e-3, 8e-3, 12e-3, 12e-3, 20e-3)
"""Search radius for a neighbour by round, metres."""

_Loose = tuple[Floats, Array]
"""A polyline, and the heights `(2,)` of its ends above the scalp."""

_LEAST_COSINE = np.cos(np.radians(45.0))
"""Of the angle between a loose strand and the neighbour that continues it."""


_LED = 20
"""Guessed connections for one strand that reaches the scalp, on average: joined strands have copies
of its path, those that are led from afar nobody's. Beyond that number a patch's few roots are
chance."""


@dataclass(frozen=True)
class Rooted:
    """Rooted strands, and how many loose ones were connected `to_scalp`, of them from more than
    8 mm above it `led`, `joined` a rooted neighbour or were `dropped`."""

    strands: list[Floats]
    to_scalp: int
    led: int
    joined: int
    dropped: int

    @property
    def reaches(self) -> bool:
        """Whether the strands reach the scalp: most of them, and enough without a guess."""
        guessed = self.joined + self.led
        itself = len(self.strands) - guessed
        return self.dropped <= len(self.strands) and guessed <= _LED * itself


def root_all(rooted: list[Floats], loose: list[Floats], scalp: Scalp) -> Rooted:
    """Give every loose polyline `(N, 3)` a root; its own points do not move.

    An end within 8 mm of the scalp is connected to it. Others join the nearest rooted strand that
    continues them within 45 degrees: from there directly to the scalp if that is at most 40 mm
    below, else parallel to the strand with an offset that fades to its root. Joined strands take
    part in the next round, with a larger radius. The rest are connected from their lower end if it
    is at most 40 mm above the scalp, else dropped.
    """
    strands = list(rooted)
    if not loose:
        return Rooted(strands, 0, 0, 0, 0)
    below = _Below(scalp)
    pending: list[_Loose] = []
    for path, h in zip(loose, below.heights(_ends(loose)), strict=True):
        if h.min() > _NEAR:
            pending.append((path, h))
        else:
            strands.append(below.lead_lower(path, h))
    to_scalp = len(strands) - len(rooted)
    joined = 0
    for reach in _REACHES:
        if not pending or not strands:
            break
        attached, pending = _join_round(strands, pending, reach, below)
        joined += len(attached)
        strands += attached
    led = [below.lead_lower(path, h) for path, h in pending if h.min() <= _HIGHEST]
    return Rooted(strands + led, to_scalp + len(led), len(led), joined, len(pending) - len(led))


class _Below:
    """Connections to the scalp below a strand."""

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
        """The path with a cubic Hermite connection from the scalp before it, which leaves along the
        scalp's normal and rises at about 45 degrees."""
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
    some = np.flatnonzero((place > 0) & (place % _STRIDE == 0))  # not the roots
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
    """The path with a connection to the guide's root before it, parallel to the guide."""
    offset = path[0] - guide[-1]
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(guide, axis=0), axis=1))])
    share = arc / max(arc[-1], 1e-12)
    fade = share * share * (3 - 2 * share)
    way = guide + fade[:, None] * offset
    # the guide's last point coincides with the path's first
    return np.concatenate([way[:-1].astype(np.float32), path])

"""Directions in which triangulated points lie in lines, as those of a fibre or a wisp do."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from reconstruction.arrays import AnyFloats, Array, Floats
from reconstruction.light_planes.point_cloud import PointCloud
from reconstruction.tangents.pooling import MOST_RADIUS

WIDTH = 1.4
"""Pixels across a line up to which a point counts."""

REACH = 6.0
"""Pixels along it."""

WIDEST_PIXEL = MOST_RADIUS / REACH
"""Metres, 1.7 mm: pixels on the hair up to which points can show lines."""

NEIGHBOURS, FEW = 64, 16
"""Most neighbours that count, and how many halve the score: few lie in a line by chance."""

_ROWS = 1000  # points processed at once: 64,000 neighbours under every direction


def halves_of_lines(
    points: AnyFloats, cloud: PointCloud, second: Sequence[str], pixel: float, candidates: Array
) -> Floats | None:
    """`line_scores` `(2, N, D)` in the points of all cameras but the `second` ones, and in theirs.

    None without any point, and where `REACH` is more than the distance in which hair turns.
    """
    if not len(cloud) or pixel > WIDEST_PIXEL:
        return None
    theirs = np.isin(cloud.camera, [cloud.cameras.index(name) for name in second])
    halves = (cloud.points[~theirs], cloud.points[theirs])
    return np.stack([line_scores(points, half, pixel, candidates) for half in halves])


def line_scores(points: AnyFloats, others: AnyFloats, pixel: float, candidates: Array) -> Floats:
    """Scores `(N, D)` of `candidates (D, 3)`: how many neighbours lie on the line through a point.

    The sum over at most `NEIGHBOURS` of `others (M, 3)` within `REACH` of each of `points (N, 3)`
    of 1 - (distance across / `WIDTH`)², at least 0, by their number plus `FEW`, less the mean over
    the directions; 0 without neighbours. On a smooth surface all its tangents score alike. `pixel`
    is the width of a camera's pixel there, metres. Errors of 1e-5.
    """
    out = np.zeros((len(points), len(candidates)), np.float32)
    if not len(others):
        return out
    tree, k = cKDTree(others), np.arange(1, min(NEIGHBOURS, len(others)) + 1)
    towards = candidates.T.astype(np.float32)
    for first in range(0, len(points), _ROWS):
        at = points[first : first + _ROWS]
        distance, index = tree.query(at, k, distance_upper_bound=REACH * pixel, workers=-1)
        found = np.isfinite(distance)
        weight = found / (found.sum(axis=1, keepdims=True) + np.float32(FEW))
        offset = (others[np.where(found, index, 0)] - at[:, None]) / (WIDTH * pixel)
        offset = np.where(found[..., None], offset, 0.0).astype(np.float32)
        inside = offset @ towards
        inside *= inside
        inside += 1 - (offset * offset).sum(axis=2, keepdims=True)
        np.maximum(inside, 0, out=inside)
        out[first : first + _ROWS] = np.einsum("nk,nkd->nd", weight.astype(np.float32), inside)
    out -= out.mean(axis=1, keepdims=True)
    return out

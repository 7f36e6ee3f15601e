"""Control points of cubic B-splines that pass through the points of strands.

A uniform cubic B-spline only approximates its control points: strands used as control points
shrink towards the inside of every bend. Splines rather than polylines, because a highlight follows
the tangent, and a polyline's tangent jumps; the cost is about a quarter more time per ray.
"""

from __future__ import annotations

import numpy as np

from reconstruction.arrays import Array, Ints
from reconstruction.geometry.strands import Strands

MOST_UNEVEN = 2.0
"""Ratio of a strand's longest to its shortest segment above which a uniform spline overshoots."""


def spline_control_points(strands: Strands) -> tuple[Array, Ints]:
    """Control points `(M, 4)`, M = N + 2 S (x, y, z, radius), and the segments' first `(N - S,)`.

    Points are interpolated with natural ends (no curvature at root and tip), for all strands of one
    length at a time. Strands whose points are spaced too unevenly are resampled at equal arc
    lengths first, as many points as before.
    """
    strands = _evened(strands)
    counts = np.diff(strands.offsets)
    first = strands.offsets[:-1] + 2 * np.arange(len(strands))
    radius = np.broadcast_to(np.asarray(strands.radius, float), len(strands.points))
    out = np.empty((len(strands.points) + 2 * len(strands), 4))
    for n in np.unique(counts):
        which = np.flatnonzero(counts == n)
        take = strands.offsets[which][:, None] + np.arange(n)
        solved = _interpolating(strands.points[take].astype(float))
        put = first[which][:, None] + np.arange(n + 2)
        out[put, :3] = solved
        out[put, 3] = np.pad(radius[take], ((0, 0), (1, 1)), mode="edge")
    segments = np.repeat(first, counts - 1) + _ranges(counts - 1)
    return out, segments


def _interpolating(points: Array) -> Array:
    """Control points `(S, n + 2, 3)` of the natural splines through `points (S, n, 3)`.

    (c[i-1] + 4 c[i] + c[i+1]) / 6 = p[i] with c[0] = p[0], c[n-1] = p[n-1]; the phantom ends
    follow from zero curvature. A Thomas solve whose coefficients all strands share.
    """
    n = points.shape[1]
    inner = points.copy()
    if n > 2:
        right = 6 * points[:, 1:-1]
        right[:, 0] -= points[:, 0]
        right[:, -1] -= points[:, -1]
        ratio = np.empty(n - 2)
        ratio[0] = 0.25
        for i in range(1, n - 2):
            ratio[i] = 1 / (4 - ratio[i - 1])
        right[:, 0] *= ratio[0]
        for i in range(1, n - 2):
            right[:, i] = (right[:, i] - right[:, i - 1]) * ratio[i]
        for i in range(n - 4, -1, -1):
            right[:, i] -= ratio[i] * right[:, i + 1]
        inner[:, 1:-1] = right
    before = 2 * inner[:, :1] - inner[:, 1:2]
    after = 2 * inner[:, -1:] - inner[:, -2:-1]
    return np.concatenate([before, inner, after], axis=1)


def _evened(strands: Strands) -> Strands:
    """`strands` with the unevenly spaced ones resampled at their own mean segment length."""
    if len(strands) == 0:
        return strands
    starts = strands.segment_starts
    points = strands.points.astype(float)
    length = np.linalg.norm(points[starts + 1] - points[starts], axis=1)
    edges = strands.offsets[:-1] - np.arange(len(strands))
    longest = np.maximum.reduceat(length, edges)
    shortest = np.minimum.reduceat(length, edges)
    uneven = np.flatnonzero(longest > MOST_UNEVEN * shortest)
    if len(uneven) == 0:
        return strands
    arc = np.zeros(len(points))
    arc[starts + 1] = length
    arc = np.cumsum(arc)
    radius = np.broadcast_to(np.asarray(strands.radius, float), len(points))
    out, out_radius = points.copy(), radius.copy()
    for i in uneven:
        span = slice(strands.offsets[i], strands.offsets[i + 1])
        at = np.linspace(arc[span][0], arc[span][-1], len(arc[span]))
        for k in range(3):
            out[span, k] = np.interp(at, arc[span], points[span, k])
        out_radius[span] = np.interp(at, arc[span], radius[span])
    varies = isinstance(strands.radius, np.ndarray)
    return Strands(
        out.astype(np.float32),
        strands.offsets,
        out_radius.astype(np.float32) if varies else strands.radius,
    )


def _ranges(counts: Ints) -> Ints:
    """0 … counts[0]-1, 0 … counts[1]-1, … in one array."""
    ends = np.cumsum(counts)
    return np.arange(ends[-1] if len(ends) else 0) - np.repeat(ends - counts, counts)

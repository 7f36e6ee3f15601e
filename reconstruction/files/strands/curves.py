"""Cubic curves as polylines: the bases and ends of USD's `BasisCurves`.

A curve's segments become Bézier segments, each divided until its chords leave it by less than
`TOLERANCE` (openusd.org, UsdGeomBasisCurves: vstep 3 for Bézier, else 1; pinned curves have a
phantom point before the first and behind the last, on the line through the outer two).
"""

from __future__ import annotations

import numpy as np

from reconstruction.arrays import Array, Ints

TOLERANCE = 1e-5
"""Metres between a curve and its polyline."""
MOST = 32
"""Chords of a segment."""
TO_BEZIER = {
    "bezier": np.eye(4),
    "catmullRom": np.array([[0, 6, 0, 0], [-1, 6, 1, 0], [0, 1, 6, -1], [0, 0, 6, 0]]) / 6,
    "bspline": np.array([[1, 4, 1, 0], [0, 4, 2, 0], [0, 2, 4, 0], [0, 1, 4, 1]]) / 6,
}
"""A segment's Bézier points from its four control points, by basis."""


def segment_counts(basis: str, counts: Ints, pinned: bool) -> Ints | None:
    """Segments of curves of so many points; None if a curve does not end at a segment's end."""
    if basis == "linear" or (pinned and basis != "bezier"):
        return counts - 1
    if (counts < 4).any() or (basis == "bezier" and ((counts - 4) % 3).any()):
        return None
    return (counts - 4) // 3 + 1 if basis == "bezier" else counts - 3


def on_curve(
    basis: str, points: Array, counts: Ints, widths: Array, pinned: bool, varying: bool
) -> tuple[Array, Ints, Array]:
    """Points `(M, 3)` on the curves with control points `(N, 3)`, their counts and widths `(M,)`.

    `widths` are of the control points, or, if `varying`, of the ends of segments.
    """
    values = np.column_stack([points, np.zeros(len(points)) if varying else widths])
    segments = segment_counts(basis, counts, pinned)
    assert segments is not None
    first = np.cumsum(counts) - counts
    if pinned and basis != "bezier":
        last = first + counts - 1
        before = 2 * values[first] - values[first + 1]
        behind = 2 * values[last] - values[last - 1]
        at = np.concatenate([last + 1, first])
        values = np.insert(values, at, np.concatenate([behind, before]), axis=0)
        first = first + 2 * np.arange(len(first))
    curve = np.repeat(np.arange(len(counts)), segments)
    nth = np.arange(len(curve)) - np.repeat(np.cumsum(segments) - segments, segments)
    start = first[curve] + nth * (3 if basis == "bezier" else 1)
    bezier = TO_BEZIER[basis] @ values[start[:, None] + np.arange(4)]
    if varying:
        end = np.arange(len(curve)) + curve
        left, right = widths[end], widths[end + 1]
        bezier[..., 3] = left[:, None] + (right - left)[:, None] * np.arange(4) / 3
    bend = np.linalg.norm(np.diff(bezier[..., :3], n=2, axis=1), axis=2).max(axis=1, initial=0)
    chords = np.clip(np.ceil(np.sqrt(0.75 * bend / TOLERANCE)), 1, MOST).astype(np.int64)
    # each chord's first point, and the last point of each curve
    of = np.repeat(np.arange(len(curve)), chords)
    t = (np.arange(len(of)) - np.repeat(np.cumsum(chords) - chords, chords)) / chords[of]
    weights = np.stack([(1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t**2 * (1 - t), t**3], axis=1)
    starts = np.einsum("nk,nkd->nd", weights, bezier[of])
    ends = np.cumsum(segments) - 1
    counts = np.bincount(curve, chords, minlength=len(segments)).astype(np.int64)
    out = np.insert(starts, np.cumsum(counts), bezier[ends, 3], axis=0)
    return out[:, :3], counts + 1, out[:, 3]

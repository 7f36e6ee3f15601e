"""A hit's place on the scalp and along its strand, from the index of the hit segment.

Mitsuba's coordinate along all curves is one float32, a whole segment off for a few million. The
place within the segment is computed from the hit point and the segment's four control points.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from reconstruction.array_backend import for_kernels
from reconstruction.arrays import Array, Ints

NAMES = (
    "control_points",
    "segment_indices",
    "strand_of_segment",
    "first_segment",
    "root_uv",
    "reference_normals",
)
"""The plugin's parameters that `strand_parameters` fills."""


def strand_parameters(
    control_points: ArrayLike,
    segments: ArrayLike,
    segments_of_strand: ArrayLike,
    root_uv: ArrayLike | None = None,
    root_normals: ArrayLike | None = None,
) -> dict[str, Any]:
    """Parameters of the curves for the dictionary of `extended_hair`.

    `control_points (N, 4)` and `segments (K,)` (the first of each segment's four control points)
    are those of the `bsplinecurve` in the scene, in its units; `segments_of_strand (S,)` counts the
    segments of each strand in the same order, and segments beyond their sum count as the last
    strand's tip. `root_uv (S, 2)` in [0, 1] places roots on the scalp; without it, strand s lies at
    ((s + 0.5)/S, 0.5). `root_normals (S, 3)` starts each strand's frame of normals and should move
    with the head; without it, the frames follow the world's x axis. Raises `ValueError` on shapes
    that do not fit.
    """
    points = np.asarray(control_points, float).reshape(-1, 4)
    first_point = np.asarray(segments, np.int64)
    counts = np.asarray(segments_of_strand, np.int64)
    strands, total = len(counts), int(counts.sum())
    if strands == 0 or counts.min() < 1 or total > len(first_point):
        raise ValueError(
            f"segments_of_strand must be positive and add up to at most the {len(first_point)} "
            f"segments, got {strands} strands with {total}"
        )
    uv = np.stack([(np.arange(strands) + 0.5) / strands, np.full(strands, 0.5)], -1)
    if root_uv is not None:
        uv = np.asarray(root_uv, float)
    if uv.shape != (strands, 2) or not ((uv >= 0) & (uv <= 1)).all():
        raise ValueError(f"root_uv must be ({strands}, 2) in [0, 1], got shape {uv.shape}")
    normals = transported_normals(points[:, :3], first_point[:total], counts, root_normals)
    beyond = len(first_point) - total
    strand = np.repeat(np.arange(strands), counts)
    return {
        "control_points": mi.Float(for_kernels(points.ravel())),
        "segment_indices": mi.UInt32(for_kernels(first_point, np.uint32)),
        "strand_of_segment": mi.UInt32(for_kernels(np.pad(strand, (0, beyond), "edge"), np.uint32)),
        "first_segment": mi.UInt32(for_kernels(np.append(0, np.cumsum(counts)), np.uint32)),
        "root_uv": mi.Float(for_kernels(uv.ravel())),
        "reference_normals": mi.Float(
            for_kernels(np.pad(normals, ((0, beyond), (0, 0)), "edge").ravel())
        ),
    }


def transported_normals(
    points: Array,
    segments: Ints,
    segments_of_strand: Ints,
    root_normals: ArrayLike | None = None,
) -> Array:
    """Unit normals `(K, 3)` at the middles of the segments, transported along each strand.

    Parallel transport: from one segment to the next, the least rotation that takes one tangent to
    the other, so that they do not turn about the strand. `points (N, 3)`; the rest as for
    `strand_parameters`. Roots without `root_normals (S, 3)` start from the x axis, turned by the
    least rotation that takes +z to the tangent: neighbours start alike.
    """
    p = [points[segments + i] for i in range(4)]
    tangents = _unit(p[3] - p[0] + 5 * (p[2] - p[1]))
    ends = np.cumsum(segments_of_strand)
    starts = ends - segments_of_strand
    up, across = np.array([0.0, 0, 1]), np.array([1.0, 0, 0])
    if root_normals is None:
        root = _turned(np.broadcast_to(across, (len(starts), 3)), up, tangents[starts])
    else:
        root = np.asarray(root_normals, float)
        if root.shape != (len(starts), 3):
            raise ValueError(f"root_normals must be ({len(starts)}, 3), got {root.shape}")
    return transported(tangents, segments_of_strand, root)


def transported(tangents: Array, counts: Ints, root: Array) -> Array:
    """Unit normals `(K, 3)` of unit `tangents (K, 3)`, `counts (S,)` of them to a strand.

    Each strand begins with the part of its `root (S, 3)` across the first tangent.
    """
    starts = np.cumsum(counts) - counts
    normals = np.empty_like(tangents)
    normals[starts] = _upright(root, tangents[starts])
    for i in range(1, int(counts.max())):
        at = starts[counts > i] + i
        moved = _turned(normals[at - 1], tangents[at - 1], tangents[at])
        normals[at] = _upright(moved, tangents[at])
    return normals


def _turned(v: Array, before: Array, after: Array) -> Array:
    """`v`, perpendicular to `before`, turned by the least rotation from `before` to `after`."""
    cosine = (before * after).sum(-1, keepdims=True)
    along = (v * after).sum(-1, keepdims=True)
    return np.asarray(v - along / np.maximum(1 + cosine, 1e-9) * (before + after))


def _upright(v: Array, tangents: Array) -> Array:
    """`v` without its part along `tangents`, of unit length; any normal where none is left."""
    left = v - (v * tangents).sum(-1, keepdims=True) * tangents
    least = np.eye(3)[np.abs(tangents).argmin(-1)]
    other = least - (least * tangents).sum(-1, keepdims=True) * tangents
    return _unit(np.where(np.linalg.norm(left, axis=-1, keepdims=True) > 1e-6, left, other))


def _unit(v: Array) -> Array:
    return np.asarray(v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-300))


def place_in_segment(p: Any, control_points: Any, first: Any, active: Any) -> tuple[Any, Any]:
    """Where on a cubic B-spline segment the point nearest to `p` lies, and the tangent there.

    The place is the segment's parameter in [0, 1]; the tangent is in scene units per segment.
    `first` is the segment's first control point, in `control_points` (x, y, z, radius, …). From the
    projection on the chord, two steps of Gauss-Newton.
    """
    c = [dr.gather(mi.Point4f, control_points, first + i, active) for i in range(4)]
    # relative to p: far from the origin, sums of coordinates would round a tangent away
    a, b, d, e = (mi.Vector3f(q.x, q.y, q.z) - p for q in c)

    def point(v: Any) -> Any:
        w = 1 - v
        inner = (3 * v**3 - 6 * v**2 + 4) * b + (3 * w**3 - 6 * w**2 + 4) * d
        return (w**3 * a + inner + v**3 * e) / 6

    def tangent(v: Any) -> Any:
        inner = v * (3 * v - 4) * b + (1 + v * (2 - 3 * v)) * d
        return 0.5 * (v**2 * e - (1 - v) ** 2 * a + inner)

    start, end = (a + 4 * b + d) / 6, (b + 4 * d + e) / 6
    v = _projected(-start, end - start)
    for _ in range(2):
        v = v + _projected(-point(v), tangent(v))
    v = dr.clip(v, 0, 1)
    return v, tangent(v)


def _projected(p: Any, direction: Any) -> Any:
    return dr.dot(p, direction) / dr.maximum(dr.squared_norm(direction), 1e-30)

"""Line segments in space, one for each pixel, and their support by other views (Sun §4.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import drjit as dr
import numpy as np

from reconstruction.array_backend import array_types, for_kernels
from reconstruction.arrays import Array, Bools, Ints
from reconstruction.light_codes.code_views import View
from reconstruction.light_codes.search import DepthMap

_NONE = 2**32 - 1  # the number of no segment


@dataclass(frozen=True, eq=False)
class Segments:
    """`points (N, 3)` and unit `directions (N, 3)` of arbitrary sign.

    `confidence (N,)` in [0, 1] is the agreement of the views; `view (N,)` the view of origin,
    `supports (N,)` the number of views that agree, its own included.
    """

    points: Array
    directions: Array
    confidence: Array
    view: Ints
    supports: Ints

    def __len__(self) -> int:
        return len(self.points)

    def subset(self, which: Bools) -> Segments:
        """The segments where `which (N,)`."""
        return Segments(*(getattr(self, f.name)[which] for f in fields(self)))


def to_segments(views: Sequence[View], maps: Sequence[DepthMap]) -> Segments:
    """All segments of the views' depth maps; each is supported by its own view alone."""
    points, directions, confidence, owner = [], [], [], []
    for k, (view, found) in enumerate(zip(views, maps, strict=True)):
        points.append(_lift(view, found))
        directions.append(found.direction.astype(float))
        confidence.append(found.agreement.astype(float))
        owner.append(np.full(len(found.x), k, np.int64))
    return Segments(
        np.concatenate(points),
        np.concatenate(directions),
        np.concatenate(confidence),
        np.concatenate(owner),
        np.ones(sum(map(len, owner)), np.int64),
    )


def count_supports(
    views: Sequence[View],
    maps: Sequence[DepthMap],
    segments: Segments,
    *,
    distance: float = 1e-3,
    angle_deg: float = 10.0,
) -> Segments:
    """The segments with their `supports`.

    Another view agrees if it has a segment within `distance` metres and `angle_deg`, at most a
    pixel from the projection.
    """
    if not len(segments):
        return segments
    t = array_types()
    points, directions = (
        t.Float(for_kernels(v.ravel())) for v in (segments.points, segments.directions)
    )
    lane = dr.arange(t.UInt32, len(segments))
    p, d = dr.gather(t.Array3f, points, lane), dr.gather(t.Array3f, directions, lane)
    owner = t.UInt32(for_kernels(segments.view, np.uint32))
    supports = dr.full(t.UInt32, 1, len(segments))
    near, like = (dr.opaque(t.Float, v) for v in (distance**2, np.cos(np.radians(angle_deg))))
    start = 0
    for k, (view, found) in enumerate(zip(views, maps, strict=True)):
        camera = view.camera
        index = np.full((camera.height + 2, camera.width + 2), _NONE, np.uint32)
        index[found.y + 1, found.x + 1] = start + np.arange(len(found.x), dtype=np.uint32)
        start += len(found.x)
        of_pixel = t.UInt32(for_kernels(index.ravel(), np.uint32))
        row = dr.opaque(t.UInt32, camera.width + 2)
        projection = camera.K @ np.column_stack([camera.R, camera.t])
        m = [dr.opaque(t.Float, float(v)) for v in projection.ravel()]
        x, y, z = (m[i] * p.x + m[i + 1] * p.y + m[i + 2] * p.z + m[i + 3] for i in (0, 4, 8))
        sees = (owner != dr.opaque(t.UInt32, k)) & (z > 0)
        inverse = dr.rcp(dr.select(sees, z, 1))
        x, y = x * inverse + 0.5, y * inverse + 0.5
        sees &= (x >= 0) & (x < t.Float(dr.opaque(t.UInt32, camera.width)))
        sees &= (y >= 0) & (y < t.Float(dr.opaque(t.UInt32, camera.height)))
        corner = t.UInt32(y) * row + t.UInt32(x)
        agrees = t.Bool(False)
        for dy, dx in np.ndindex(3, 3):
            tested = sees & ~agrees
            j = dr.gather(t.UInt32, of_pixel, corner + dy * row + dx, tested)
            tested &= j != _NONE
            away = dr.squared_norm(dr.gather(t.Array3f, points, j, tested) - p)
            cosine = dr.abs(dr.dot(dr.gather(t.Array3f, directions, j, tested), d))
            agrees |= tested & (away <= near) & (cosine >= like)
        supports += dr.select(agrees, t.UInt32(1), t.UInt32(0))
        dr.eval(supports)
    return replace(segments, supports=np.array(supports).astype(np.int64))


def thinned_lines(
    points: Array, directions: Array, weights: Array, spacing: float
) -> tuple[Array, Array, Array]:
    """Weighted mean lines for each cell of `spacing` metres and largest direction component.

    Points `(M, 3)`, directions `(M, 3)` and summed weights `(M,)`.
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


def _lift(view: View, found: DepthMap) -> Array:
    rays = view.camera.rays(np.stack([found.x, found.y], axis=1))
    rays /= (rays @ view.camera.R[2])[:, None]
    return view.camera.center + rays * found.depth[:, None].astype(float)

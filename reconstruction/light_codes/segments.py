"""Line segments in space, one for each pixel, and which of them other views confirm (Sun §4.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from reconstruction.arrays import Array, Bools, Ints
from reconstruction.light_codes.code_views import View
from reconstruction.light_codes.search import DepthMap


@dataclass(frozen=True, eq=False)
class Segments:
    """`points (N, 3)`, unit `directions (N, 3)` whose sign means nothing, and their origin.

    `confidence (N,)` in [0, 1] is the agreement of the views; `view (N,)` numbers the view that
    each was found in, `supports (N,)` counts the views that agree with it, its own among them.
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
    """The segments with the number of views that agree: each counts itself and others like it.

    Another view agrees where it found, within a pixel of where it would see the segment, one of
    its own within `distance` metres and `angle_deg` of it.
    """
    supports = np.ones(len(segments), np.int64)
    least = np.cos(np.radians(angle_deg))
    start = 0
    for k, (view, found) in enumerate(zip(views, maps, strict=True)):
        index = np.full((view.camera.height + 2, view.camera.width + 2), -1, np.int64)
        index[found.y + 1, found.x + 1] = start + np.arange(len(found.x))
        start += len(found.x)
        other = np.flatnonzero(segments.view != k)
        pixels, depth = view.camera.project(segments.points[other])
        on = (depth > 0) & view.camera.inside(pixels)
        other, at = other[on], np.rint(pixels[on]).astype(np.int64)
        agrees = np.zeros(len(other), bool)
        for dy, dx in np.ndindex(3, 3):
            j = index[at[:, 1] + dy, at[:, 0] + dx]
            some = np.flatnonzero((j >= 0) & ~agrees)
            i, j = other[some], j[some]
            near = np.linalg.norm(segments.points[i] - segments.points[j], axis=1) <= distance
            cosine = np.einsum("nk,nk->n", segments.directions[i], segments.directions[j])
            agrees[some] = near & (np.abs(cosine) >= least)
        supports[other[agrees]] += 1
    return replace(segments, supports=supports)


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


def _lift(view: View, found: DepthMap) -> Array:
    rays = view.camera.rays(np.stack([found.x, found.y], axis=1))
    rays /= (rays @ view.camera.R[2])[:, None]
    return view.camera.center + rays * found.depth[:, None].astype(float)

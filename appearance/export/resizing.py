"""Another number of strands for an export: some of a model's, or more between them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree

from reconstruction import Strands
from reconstruction.arrays import Array, Floats, Ints

_NEIGHBOURS = 32
_NEAREST = 4
"""The distance to the strand of this order gives the area that a strand has around it."""
_ALONG = 3.0
"""Standard deviation, points, over which that area is averaged along a strand."""
_WIDEST = 2.0
"""Multiple of the median distance that new strands keep to: fly-aways are not spread."""


def resized(strands: Strands, count: int | None, seed: int) -> tuple[Strands, Ints]:
    """`count` strands in place of those given, and the index of each one's model `(count,)`.

    Fewer are drawn at random; more are added parallel to those given (`_between`), with confidence
    0. The radius is multiplied by the ratio of the total covered areas.
    """
    size = len(strands)
    if count is None or count == size or not size:
        return strands, np.arange(size)
    if count < size:
        ids = np.sort(np.random.default_rng(seed).choice(size, count, replace=False))
        out = strands.subset(ids)
    else:
        out, ids = _between(strands, count - size, seed)
    # of radii that vary the area counts, length by length
    area = _area(out)
    if not area:  # strands without length: no radius makes up for the others
        return out, ids
    return replace(out, radius=out.radius * (_area(strands) / area)), ids


def _between(strands: Strands, count: int, seed: int) -> tuple[Strands, Ints]:
    """The strands and `count` more between them, and each one's model, in its order.

    A new strand has a constant place in the disc of area that its model has around it, at right
    angles to it in a frame that does not rotate about it, so both have the same tangents where
    strands are equally dense. Models are drawn in proportion to that area.
    """
    rng = np.random.default_rng(seed)
    radius = _disc(strands)
    counts = np.diff(strands.offsets)
    area = np.bincount(strands.strand_of_point, radius**2, len(strands)) / counts
    edges = np.cumsum(area)
    drawn = np.searchsorted(edges, edges[-1] * (np.arange(count) + rng.random()) / count)
    ids = np.sort(np.concatenate([np.arange(len(strands)), np.minimum(drawn, len(strands) - 1)]))
    added = np.r_[False, ids[1:] == ids[:-1]]
    out = strands.subset(ids)
    place = np.sqrt(rng.random(len(ids))) * added
    turn = 2 * np.pi * rng.random(len(ids))
    across = np.stack([place * np.cos(turn), place * np.sin(turn)])
    one, other = _frames(strands)
    source = np.repeat(strands.offsets[ids] - out.offsets[:-1], np.diff(out.offsets))
    source += np.arange(len(source))
    u, v = across[:, out.strand_of_point] * radius[source]
    points = out.points + u[:, None] * one[source] + v[:, None] * other[source]
    guessed = added[out.strand_of_point]
    confidence = None if out.confidence is None else np.where(guessed, 0, out.confidence)
    return replace(out, points=points, confidence=confidence), ids


def _disc(strands: Strands) -> Array:
    """Radius `(N,)`, metres, of the disc whose area a strand has around it at each point.

    At least its own radius, which it has without neighbours.
    """
    points, tangents = strands.points.astype(float), strands.tangents().astype(float)
    owner = strands.strand_of_point
    starts = strands.segment_starts
    step = np.linalg.norm(points[starts + 1] - points[starts], axis=1).mean()
    _, near = cKDTree(points).query(points, k=min(_NEIGHBOURS, len(points)))
    away = points[near] - points[:, None]
    along = np.einsum("nkc,nc->nk", away, tangents)
    apart = np.sqrt(np.maximum((away**2).sum(2) - along**2, 0))
    beside = (owner[near] != owner[:, None]) & (np.abs(along) <= step / 2)
    apart = np.sort(np.where(beside, apart, np.inf), axis=1)
    known = apart[:, _NEAREST - 1] if apart.shape[1] >= _NEAREST else np.full(len(points), np.inf)
    disc = known / np.sqrt(_NEAREST)
    seen = np.isfinite(disc)
    widest = _WIDEST * float(np.median(disc[seen])) if seen.any() else 0.0
    disc = np.maximum(np.minimum(disc, widest), strands.radius)
    parts = np.split(disc, strands.offsets[1:-1])
    return np.concatenate([gaussian_filter1d(d, _ALONG, mode="nearest") for d in parts])


def _frames(strands: Strands) -> tuple[Floats, Floats]:
    """Two unit vectors `(N, 3)` at right angles to the strand, carried along it unrotated."""
    tangents = strands.tangents().astype(float)
    offsets = strands.offsets
    first = tangents[offsets[:-1]]
    axis = np.eye(3)[np.abs(first).argmin(axis=1)]
    one = np.zeros(tangents.shape)
    for k in range(int(np.diff(offsets).max())):
        alive = offsets[:-1] + k < offsets[1:]
        at = offsets[:-1][alive] + k
        t = tangents[at]
        axis[alive] -= (axis[alive] * t).sum(1, keepdims=True) * t
        axis[alive] /= np.maximum(np.linalg.norm(axis[alive], axis=1, keepdims=True), 1e-12)
        one[at] = axis[alive]
    return one.astype(np.float32), np.cross(tangents, one).astype(np.float32)


def _area(strands: Strands) -> float:
    starts = strands.segment_starts
    points = strands.points.astype(float)
    length = np.linalg.norm(points[starts + 1] - points[starts], axis=1)
    radius = np.broadcast_to(np.asarray(strands.radius, float), len(points))
    return float(length @ radius[starts])

"""Strands packed for a browser: equal point counts, 16 bits per coordinate, coarse to fine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from reconstruction import Strands
from reconstruction.arrays import Array, Floats, Ints
from reconstruction.geometry.splines import spline_control_points

POINTS = (16, 24, 32, 48, 64, 96, 128, 192, 256)
"""Possible numbers of points per strand, equal for all strands of a set."""
TOLERANCE = 1.5e-4
"""Metres of deviation that 95 % of the points may reach; decides the number of points. Shadows and
occlusion change from about a third of a strand's radius on."""
MOST_POINTS = 8_000_000
_GOLDEN = 0.6180339887498949
_LEVELS = 65_535


@dataclass(frozen=True, eq=False)
class PackedStrands:
    """Strands, each resampled at equal arc lengths to `n` points.

    points (S, n, 3)    uint16; the place in metres is `low (3,) + step * points`
    lengths, radii (S,) float32, metres
    order (S,)          index of each in the model; prefixes are spread over all strands
    deviation           metres of the rendered curves from these polylines, with the rounding to 16
                        bits: the 50th, 95th and 100th percentile
    """

    points: NDArray[np.uint16]
    lengths: Floats
    radii: Floats
    order: Ints
    low: Array
    step: float
    deviation: tuple[float, float, float]

    @classmethod
    def of(cls, strands: Strands) -> PackedStrands:
        """With the fewest points per strand that keep `TOLERANCE`, if `MOST_POINTS` allows."""
        order = np.argsort(np.arange(len(strands)) * _GOLDEN % 1, kind="stable")
        if not len(strands):
            none = np.zeros(0, np.float32)
            empty = np.zeros((0, POINTS[0], 3), np.uint16)
            return cls(empty, none, none, order, np.zeros(3), 1e-5, (0.0, 0.0, 0.0))
        affordable = [n for n in POINTS if n * len(strands) <= MOST_POINTS] or [POINTS[0]]
        line = _Polylines(_with_middles(strands))
        few = _Polylines(_with_middles(strands.subset(order[:2000])))
        count = next(
            (n for n in affordable if np.percentile(few.missed(few.points(n)), 95) <= TOLERANCE),
            affordable[-1],
        )
        points = line.points(count)
        low = points.min(axis=(0, 1))
        step = float(max((points.max(axis=(0, 1)) - low).max() / _LEVELS, 1e-9))
        packed = np.rint((points - low) / step).astype(np.uint16)
        missed = line.missed(low + step * packed)
        radius = np.broadcast_to(np.asarray(strands.radius, float), len(strands.points))
        mean = np.add.reduceat(radius, strands.offsets[:-1]) / np.diff(strands.offsets)
        return cls(
            packed[order],
            strands.lengths()[order].astype(np.float32),
            mean[order].astype(np.float32),
            order,
            low,
            step,
            tuple(float(x) for x in np.percentile(missed, [50, 95, 100])),  # type: ignore[arg-type]
        )

    def positions(self) -> Floats:
        """The packed points `(S, n, 3)`, metres."""
        return (self.low + self.step * self.points).astype(np.float32)

    def chunk(self, first: int, count: int) -> bytes:
        """Strands `first` to `first + count`: points, then lengths, then radii, little-endian."""
        part = slice(first, first + count)
        return b"".join(
            np.ascontiguousarray(x).astype(x.dtype.newbyteorder("<")).tobytes()
            for x in (self.points[part], self.lengths[part], self.radii[part])
        )


def _with_middles(strands: Strands) -> Strands:
    """`strands` with a point in the middle of each segment of the renderer's splines."""
    control, first = spline_control_points(strands)
    pieces = control[first[:, None] + np.arange(4), :3]
    offsets = 2 * strands.offsets - np.arange(len(strands.offsets))
    points = np.empty((offsets[-1], 3), np.float32)
    points[offsets[1:] - 1] = strands.points[strands.offsets[1:] - 1]
    starts = strands.segment_starts
    at = 2 * starts - strands.strand_of_point[starts]
    points[at] = np.einsum("k,skx->sx", np.array([1, 4, 1, 0]) / 6, pieces)
    points[at + 1] = np.einsum("k,skx->sx", np.array([1, 23, 23, 1]) / 48, pieces)
    return Strands(points, offsets)


class _Polylines:
    """Strands parametrised by their cumulative arc length, interpolated together."""

    def __init__(self, strands: Strands) -> None:
        self._points, self._offsets = strands.points.astype(float), strands.offsets
        starts = strands.segment_starts
        along = np.zeros(len(self._points))
        along[starts + 1] = np.linalg.norm(self._points[starts + 1] - self._points[starts], axis=1)
        self._strand = strands.strand_of_point
        self._arc = np.cumsum(along)
        self._begin = self._arc[self._offsets[:-1]]
        self._length = self._arc[self._offsets[1:] - 1] - self._begin
        self._key = self._arc + self._strand  # a gap of 1 separates strands

    def points(self, count: int) -> Array:
        """`count` points of each strand at equal arc lengths `(S, count, 3)`."""
        share = np.linspace(0, 1, count)
        at = self._begin[:, None] + self._length[:, None] * share
        at += np.arange(len(self._length))[:, None]
        return np.stack([np.interp(at, self._key, x) for x in self._points.T], axis=-1)

    def missed(self, points: Array) -> Array:
        """Distance of each point from resampled `points (S, n, 3)` at the same arc length."""
        last = points.shape[1] - 1
        within = self._arc - self._begin[self._strand]
        length = self._length[self._strand]
        place = last * np.divide(within, length, out=np.zeros_like(within), where=length > 0)
        left = np.minimum(place.astype(np.int64), last - 1)
        share = (place - left)[:, None]
        a, b = points[self._strand, left], points[self._strand, left + 1]
        return np.linalg.norm(a * (1 - share) + b * share - self._points, axis=1)

"""Hair as polylines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from reconstruction.arrays import AnyFloats, Array, Floats, Ints


@dataclass(frozen=True, eq=False)
class Strands:
    """Strands as polylines, root first.

    `points (N, 3) float32` in metres; strand `i` is `points[offsets[i]:offsets[i + 1]]` with
    `offsets (S + 1,) int64`; `radius` in metres, a scalar or `(N,)`. `confidence (N,)` in [0, 1],
    if known, is the agreement of measurements with each point: 0 where it is guessed.

    Raises `ValueError` where offsets do not partition the points, a strand has under two points,
    a coordinate is not finite or a confidence not in [0, 1].
    """

    points: Floats
    offsets: Ints
    radius: float | Floats = 4e-5
    confidence: Floats | None = None

    def __post_init__(self) -> None:
        points = np.ascontiguousarray(self.points, dtype=np.float32).reshape(-1, 3)
        offsets = np.ascontiguousarray(self.offsets, dtype=np.int64)
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "offsets", offsets)
        if offsets.ndim != 1 or len(offsets) == 0 or offsets[0] != 0 or offsets[-1] != len(points):
            raise ValueError(f"offsets must run from 0 to the {len(points)} points, got {offsets}")
        short = np.flatnonzero(np.diff(offsets) < 2)
        if len(short):
            raise ValueError(f"{len(short)} strands have under two points, the first is {short[0]}")
        if not np.isfinite(points).all():
            raise ValueError("points must be finite")
        if isinstance(self.radius, np.ndarray):
            radius = np.ascontiguousarray(self.radius, dtype=np.float32)
            if radius.shape != (len(points),):
                raise ValueError(f"radius must be a scalar or ({len(points)},), got {radius.shape}")
            object.__setattr__(self, "radius", radius)
        if not (np.all(np.asarray(self.radius) > 0) and np.all(np.isfinite(self.radius))):
            raise ValueError("radius must be positive and finite")
        if self.confidence is not None:
            confidence = np.ascontiguousarray(self.confidence, dtype=np.float32)
            if confidence.shape != (len(points),):
                raise ValueError(f"confidence must be ({len(points)},), got {confidence.shape}")
            if not ((confidence >= 0) & (confidence <= 1)).all():
                raise ValueError("confidence must be in [0, 1]")
            object.__setattr__(self, "confidence", confidence)

    @classmethod
    def from_list(cls, strands: list[AnyFloats], radius: float = 4e-5) -> Strands:
        """Strands from a list of `(n_i, 3)` arrays; an empty list gives a head without hair."""
        offsets = np.cumsum([0, *map(len, strands)])
        points = np.concatenate(strands) if strands else np.zeros((0, 3))
        return cls(points.astype(np.float32), offsets, radius)

    def __len__(self) -> int:
        return len(self.offsets) - 1

    def __getitem__(self, i: int) -> Floats:
        """Points `(N, 3)` of strand `i`."""
        if not 0 <= i < len(self):
            raise IndexError(f"strand {i} of {len(self)}")
        return self.points[self.offsets[i] : self.offsets[i + 1]]

    @property
    def strand_of_point(self) -> Ints:
        """Index of the strand of each point `(N,)`."""
        return np.repeat(np.arange(len(self)), np.diff(self.offsets))

    @property
    def segment_starts(self) -> Ints:
        """Indices `(N - S,)` of each segment's first point; its second is one further."""
        keep = np.ones(len(self.points), bool)
        keep[self.offsets[1:] - 1] = False
        return np.flatnonzero(keep)

    @property
    def roots(self) -> Floats:
        """First points `(S, 3)`."""
        return self.points[self.offsets[:-1]]

    def lengths(self) -> Array:
        """Arc length of each strand `(S,)`, metres."""
        starts = self.segment_starts
        step = np.linalg.norm(self.points[starts + 1].astype(float) - self.points[starts], axis=1)
        return np.bincount(self.strand_of_point[starts], step, len(self)).astype(np.float64)

    def tangents(self) -> Floats:
        """Unit tangents `(N, 3)` by central differences, root to tip; 0 where points coincide."""
        p, strand = self.points.astype(float), self.strand_of_point
        index = np.arange(len(p))
        before = np.maximum(index - 1, self.offsets[strand])
        d = p[np.minimum(index + 1, self.offsets[strand + 1] - 1)] - p[before]
        return unit_or_zero(d).astype(np.float32)

    def subset(self, which: ArrayLike) -> Strands:
        """The strands at the indices (or the mask) `which (M,)`, in that order."""
        which = np.asarray(which)
        index = np.arange(len(self))[which if which.size else which.astype(np.int64)]
        counts = np.diff(self.offsets)[index]
        offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        take = np.arange(offsets[-1]) + np.repeat(self.offsets[index] - offsets[:-1], counts)
        radius = self.radius[take] if isinstance(self.radius, np.ndarray) else self.radius
        confidence = None if self.confidence is None else self.confidence[take]
        return Strands(self.points[take], offsets, radius, confidence)

    def at_most(self, count: int) -> Strands:
        """The strands, those of more points resampled to `count` at equal arc lengths.

        Radius and confidence are interpolated.
        """
        counts = np.diff(self.offsets)
        long = np.flatnonzero(counts > count)
        if not len(long):
            return self
        vary = [self.radius if isinstance(self.radius, np.ndarray) else None, self.confidence]
        columns = [c[:, None] for c in vary if c is not None]
        values = np.hstack([self.points, *columns]).astype(np.float64)
        parts = np.split(values, self.offsets[1:-1])
        for i in long:
            step = np.linalg.norm(np.diff(parts[i][:, :3], axis=0), axis=1)
            arc = np.concatenate([[0], np.cumsum(step)])
            at = np.linspace(0, arc[-1], count)
            parts[i] = np.stack([np.interp(at, arc, column) for column in parts[i].T], axis=1)
        offsets = np.concatenate([[0], np.cumsum(np.minimum(counts, count))])
        out = iter(np.concatenate(parts).astype(np.float32).T[3:])
        radius, confidence = (old if old is None else next(out) for old in vary)
        points = np.concatenate(parts)[:, :3].astype(np.float32)
        return Strands(points, offsets, self.radius if radius is None else radius, confidence)

    def transformed(self, rotation: ArrayLike, translation: ArrayLike) -> Strands:
        """The strands moved by `x -> rotation (3, 3) @ x + translation (3,)`."""
        moved = self.points.astype(float) @ np.asarray(rotation, float).T + np.asarray(translation)
        return replace(self, points=moved.astype(np.float32))

    def cut(self, length: float) -> Strands:
        """Strands that end after at most `length` metres, > 0.

        The last point is interpolated, with its radius and its confidence.
        """
        points, first = self.points.astype(float), self.offsets[:-1]
        step = np.zeros(len(points))
        starts = self.segment_starts
        step[starts + 1] = np.linalg.norm(points[starts + 1] - points[starts], axis=1)
        total = np.cumsum(step)
        arc = total - total[first][self.strand_of_point]
        keep = arc - step < length
        keep[first] = True
        beyond = np.flatnonzero(keep & (arc > length))
        share = ((length - arc[beyond - 1]) / step[beyond])[:, None]
        points[beyond] = points[beyond - 1] * (1 - share) + points[beyond] * share
        counts = np.bincount(self.strand_of_point[keep], minlength=len(self))
        offsets = np.concatenate([[0], np.cumsum(counts)])

        def ended(values: Floats) -> Floats:
            there = values.copy()
            there[beyond] += (values[beyond - 1] - values[beyond]) * (1 - share[:, 0])
            return there[keep]

        radius = ended(self.radius) if isinstance(self.radius, np.ndarray) else self.radius
        confidence = None if self.confidence is None else ended(self.confidence).clip(0, 1)
        return Strands(points[keep].astype(np.float32), offsets, radius, confidence)

    def resampled(self, step: float) -> Strands:
        """Every strand resampled at equal arc lengths of about `step` metres, ends kept.

        Strands of no length keep their two end points. A per-point radius is interpolated, and so
        is the confidence.
        """
        every = Resampling(self, step)
        index = np.arange(every.offsets[-1])
        points, radius = every(index)
        confidence = None if self.confidence is None else every.confidence(index)
        return Strands(points, every.offsets, radius, confidence)


class Resampling:
    """Points of `strands.resampled(step)` on demand; `offsets (S + 1,)` are those of the result."""

    def __init__(self, strands: Strands, step: float) -> None:
        if not step > 0:
            raise ValueError(f"step must be positive, got {step}")
        self.strands = strands
        p, starts = strands.points, strands.segment_starts
        arc = np.zeros(len(p))
        arc[starts + 1] = np.linalg.norm(p[starts + 1].astype(float) - p[starts], axis=1)
        self._arc = np.cumsum(arc)  # one growing coordinate over all strands: interpolate only once
        self._lengths = strands.lengths()
        counts = np.maximum(np.ceil(self._lengths / step).astype(np.int64), 1) + 1
        self.offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)

    def __call__(self, index: Ints) -> tuple[Floats, float | Floats]:
        """Points `(N, 3)` at `index (N,)` among all the resampled ones, and their radius."""
        p = self.strands.points
        left, w = self._place(index)
        points = (p[left] * (1 - w)[:, None] + p[left + 1] * w[:, None]).astype(np.float32)
        radius = self.strands.radius
        if isinstance(radius, np.ndarray):
            radius = (radius[left] * (1 - w) + radius[left + 1] * w).astype(np.float32)
        return points, radius

    def confidence(self, index: Ints) -> Floats:
        """Confidence `(N,)` at `index (N,)`, 0 where it is not known."""
        given = self.strands.confidence
        if given is None:
            return np.zeros(len(index), np.float32)
        left, w = self._place(index)
        return (given[left] * (1 - w) + given[left + 1] * w).clip(0, 1).astype(np.float32)

    def _place(self, index: Ints) -> tuple[Ints, Array]:
        """The given point before each of `index (N,)`, and the share of the way to the next."""
        offsets, arc = self.strands.offsets, self._arc
        strand = np.searchsorted(self.offsets, index, side="right") - 1
        last = np.diff(self.offsets)[strand] - 1
        k = index - self.offsets[strand]
        s = arc[offsets[strand]] + self._lengths[strand] * (k / last)
        low, high = offsets[strand], offsets[strand + 1] - 2
        left = np.clip(np.searchsorted(arc, s, side="right") - 1, low, high)
        span = arc[left + 1] - arc[left]
        w = np.clip(np.divide(s - arc[left], span, out=np.zeros_like(s), where=span > 0), 0, 1)
        return np.where(k == last, high, left), np.where(k == last, 1.0, w)


def unit_or_zero(vectors: Array) -> Array:
    """Unit vectors along `vectors (N, 3)`; 0 stays 0."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0)


_AT_A_TIME = 400  # lines that fit the processor's cache


def smoothed(lines: Sequence[Array], sigma: float) -> list[Array]:
    """Polylines `(N, 3)` smoothed by a Gaussian of `sigma` metres along them, ends fixed.

    The Gaussian is cut at four deviations; beyond its ends a line is extended by point reflection.
    """
    out: list[Array] = []
    for first in range(0, len(lines), _AT_A_TIME):
        out += _smoothed_together(lines[first : first + _AT_A_TIME], sigma)
    return out


def _smoothed_together(lines: Sequence[Array], sigma: float) -> list[Array]:
    x = np.concatenate(lines)
    count = np.array([len(line) for line in lines])
    ends = np.cumsum(count)
    owner = np.repeat(np.arange(len(lines)), count)
    length = np.zeros(len(x))
    length[1:] = np.linalg.norm(np.diff(x, axis=0), axis=1)
    length[ends - count] = 0.0
    step = np.bincount(owner, length, len(lines)) / np.maximum(count - 1, 1)
    fits = (count > 2) & (step > 0) & (sigma > 0)
    width = np.where(fits, sigma / np.where(fits, step, 1.0), 0.0)
    width = np.minimum(width, 2 * count)  # wider ones leave the chord alike, to 1e-5
    reach = np.ceil(4 * width).astype(np.int64)
    furthest = int(reach.max(initial=0))
    # every line with `reach` points more at both ends, end to end
    size = count + 2 * reach
    line = np.repeat(np.arange(len(lines)), size)
    place = np.arange(len(line)) - (np.cumsum(size) - size + reach)[line]
    begin, span = (ends - count)[line], np.maximum(count - 1, 1)[line]
    turn, j = np.divmod(place, 2 * span)
    last = begin + count[line] - 1
    back = j > last - begin
    longer = x[begin + np.where(back, np.minimum(2 * span - j, last - begin), j)]
    longer = np.where(back[:, None], 2 * x[last] - longer, longer)
    longer += (2 * turn)[:, None] * (x[last] - x[begin])
    longer = np.pad(longer, ((furthest, furthest), (0, 0)))
    total, weights = longer.copy(), np.ones(len(lines))
    inner = slice(furthest, furthest + len(line))
    for k in range(1, furthest + 1):
        weight = np.where(k <= 4 * width, np.exp(-0.5 * (k / np.maximum(width, 1e-9)) ** 2), 0.0)
        weights += 2 * weight
        pair = longer[inner.start - k : inner.stop - k] + longer[inner.start + k : inner.stop + k]
        pair *= weight[line][:, None]
        total[inner] += pair
    own = (place >= 0) & (place < count[line])
    return np.split(total[inner][own] / weights[owner][:, None], ends[:-1])

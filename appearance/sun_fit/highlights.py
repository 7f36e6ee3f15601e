"""What highlights show: how a pixel, and two beside each other, answer to two lights.

What is read is the same of a capture and of renderings of known roughness and disorder, which
`light_correlation` sets side by side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import pairwise
from typing import Self

import numpy as np

from appearance.observations import Observed
from appearance.sun_fit.mirror_samples import near_mirror
from appearance.sun_fit.visible_fibres import VisibleFibres
from reconstruction.arrays import AnyFloats, Array, Floats, Ints

WINDOW = np.pi / 3
"""How far from the mirror direction lights are taken, both ways."""
EDGES = np.radians([0, 8, 16, 24, 32, 40, 50, 60, 75, 90, 120])
"""Bins of |θ_i − θ_i'| of two lights."""
BESIDE = 3
"""Pixels that two pixels lie apart, in a row or a column, whose likeness is asked for.

As far as a lens's blur and a filter do not mix them.
"""
SIDE = 3
"""A view's hair is parted in 3 × 3."""
INNER = slice(4, 26)
"""Bins of the deviation that a shift brings nothing unknown into."""
SHIFTS = np.radians(np.arange(0, 31, 3))
"""Of highlights, root mean square, that profiles are read with."""
_DEVIATIONS = np.linspace(-WINDOW, WINDOW, 31)


@dataclass(frozen=True, eq=False)
class Highlight:
    """Sums over `J` parts of the hair, `SIDE`² of each view.

    `products (J, 10)` of a pixel's answers to two lights, over `EDGES`, and `pairs` how many;
    `products_beside` of two pixels' answers that lie `BESIDE` each other, and `pairs_beside`;
    `values (J, 30)` of its answers over the signed deviation from the mirror direction, and
    `samples` how many.
    """

    products: Array
    pairs: Array
    products_beside: Array
    pairs_beside: Array
    values: Array
    samples: Array

    @classmethod
    def joined(cls, views: Sequence[Self]) -> Self:
        """The highlights of several views as one; of none, nothing."""
        none = (np.zeros((0, len(edges) - 1)) for edges in 4 * [EDGES] + 2 * [_DEVIATIONS])
        return cls(
            *(
                np.concatenate([empty, *(getattr(view, f.name) for view in views)])
                for f, empty in zip(fields(cls), none, strict=True)
            )
        )

    def correlation(self, parts: Array) -> Array:
        """Mean products over `EDGES`, relative to their mean `(M, 10)`; `parts (M, J)` weigh."""
        return _relative(parts @ self.products, parts @ self.pairs)

    def likeness(self, parts: Array) -> Array:
        """How far pixels beside each other answer as one pixel does `(M,)`; `parts (M, J)` weigh.

        The slope of their mean products over those of one pixel, bin by bin: 1 where all pixels
        have the same highlight, 0 where they are strangers.
        """
        within, beside = (
            parts @ total / np.maximum(parts @ count, 1)
            for total, count in (
                (self.products, self.pairs),
                (self.products_beside, self.pairs_beside),
            )
        )
        off = within - within.mean(axis=1, keepdims=True)
        spread = np.maximum((off**2).sum(axis=1), 1e-300)
        return np.asarray((off * beside).sum(axis=1) / spread)

    def profiles(self, parts: Array) -> Array:
        """Mean answers over deviation if shifted at random `(M, S, 11)`, relative to their mean.

        `S` are normal shifts of `SHIFTS`.
        """
        mean = _relative(parts @ self.values, parts @ self.samples)
        middle = 0.5 * (_DEVIATIONS[1:] + _DEVIATIONS[:-1])
        spread = np.maximum(SHIFTS, 1e-3)[:, None, None]
        kernel = np.exp(-0.5 * ((middle[:, None] - middle) / spread) ** 2)
        kernel /= kernel.sum(axis=2, keepdims=True)
        inner = (mean @ kernel.swapaxes(1, 2)).swapaxes(0, 1)[..., INNER]
        two = inner.reshape(*inner.shape[:2], -1, 2).mean(axis=3)
        return np.asarray(two / np.maximum(two.mean(axis=2, keepdims=True), 1e-30))

    def angle(self) -> float:
        """Mean |θ_i − θ_i'|, radians, with the correlation as weight: grows with the roughness."""
        middle, width = 0.5 * (EDGES[1:] + EDGES[:-1]), np.diff(EDGES)
        weight = self.correlation(np.ones((1, len(self.pairs))))[0] * width
        return float((weight * middle).sum() / weight.sum())


@dataclass(frozen=True, eq=False)
class LightPairs:
    """`N` lights near the mirror directions of a view's pixels, and `M` pairs for the same pixel.

    `sample (N,)`, `first` and `second (M,)` are flat indices into an `(L, P)` array; `bin_of_sample
    (N,)` and `bin_of_pair (M,)` count through the bins of one part of the hair after the other;
    `scale (L, P)` turns radiance into the fibre's answer, 1/sr. The first `own` pairs are of one
    pixel, the rest of two that lie `BESIDE` each other.
    """

    sample: Ints
    bin_of_sample: Ints
    first: Ints
    second: Ints
    bin_of_pair: Ints
    own: int
    scale: Array

    @classmethod
    def of(
        cls, observed: Observed, fibres: VisibleFibres, *, tilt_deg: float, channel: int
    ) -> LightPairs:
        """Those of `observed`, whose pixels see `fibres`."""
        found = near_mirror(observed, fibres, tilt_deg, WINDOW)
        part, count = parts_of(observed), observed.valid.shape[1]
        deviation = found.deviation.ravel()
        pixel, light = np.nonzero(found.near.T)
        sample = light * count + pixel
        ends = np.searchsorted(pixel, np.arange(count + 1))
        pairs = [np.stack(np.triu_indices(b - a, 1)) + a for a, b in pairwise(ends)]
        i, j = sample[np.concatenate(pairs, axis=1)]
        angle = np.abs(deviation[i] - deviation[j])
        of_two = _pairs_beside(observed, fibres, tilt_deg)
        own = int((angle < EDGES[-1]).sum())
        i, j, angle = (
            np.concatenate([x[angle < EDGES[-1]], y[of_two[2] < EDGES[-1]]])
            for x, y in zip((i, j, angle), of_two, strict=True)
        )
        return cls(
            sample,
            part[pixel] * (len(_DEVIATIONS) - 1) + _bin(deviation[sample], _DEVIATIONS),
            i,
            j,
            part[i % count] * (len(EDGES) - 1) + _bin(angle, EDGES),
            own,
            found.squared
            / np.maximum(found.shines[..., channel], 1e-12)
            / np.maximum(fibres.share, 1e-12),
        )

    def highlight(self, one: AnyFloats, other: AnyFloats) -> Highlight:
        """What the radiances `one`, `other (L, P)` of the same pixels show.

        They are the same twice, or two renderings: then mean products are free of their noise.
        """
        a, b = (np.asarray(self.scale * x, float).ravel() for x in (one, other))
        i, j, k = self.first, self.second, self.sample
        products = 0.5 * (a[i] * b[j] + a[j] * b[i])
        own, apart = slice(None, self.own), slice(self.own, None)

        def of_pairs(values: Array, which: slice) -> Array:
            return _summed(self.bin_of_pair[which], values[which], len(EDGES) - 1)

        def of_samples(values: Array) -> Array:
            return _summed(self.bin_of_sample, values, len(_DEVIATIONS) - 1)

        return Highlight(
            of_pairs(products, own),
            of_pairs(np.ones(len(i)), own),
            of_pairs(products, apart),
            of_pairs(np.ones(len(i)), apart),
            of_samples(0.5 * (a[k] + b[k])),
            of_samples(np.ones(len(k))),
        )


@dataclass(frozen=True, eq=False)
class Highlights:
    """How highlights of `views` are read, in one colour `channel`."""

    views: Sequence[tuple[Observed, VisibleFibres]]
    tilt_deg: float
    channel: int

    def of(self, radiances: Sequence[Floats]) -> Highlight:
        """The highlights in two renderings (or twice the capture) of each view `(2, L, P, 3)`."""
        found = zip(self._pairs, radiances, strict=True)
        return Highlight.joined([p.highlight(*both[..., self.channel]) for p, both in found])

    @cached_property
    def _pairs(self) -> list[LightPairs]:
        return [
            LightPairs.of(o, f, tilt_deg=self.tilt_deg, channel=self.channel) for o, f in self.views
        ]


def beside(observed: Observed) -> Ints:
    """Places `(N, 2)` in `observed.pixels` of two that lie `BESIDE` each other, right or below."""
    pixels, width = observed.pixels, observed.camera.width
    order = np.argsort(pixels, kind="stable")
    found = []
    for step, fits in ((BESIDE, pixels % width + BESIDE < width), (BESIDE * width, True)):
        at = np.minimum(np.searchsorted(pixels[order], pixels + step), len(pixels) - 1)
        there = np.flatnonzero((pixels[order[at]] == pixels + step) & fits)
        found.append(np.stack([there, order[at[there]]], axis=1))
    return np.concatenate(found)


def _pairs_beside(
    observed: Observed, fibres: VisibleFibres, tilt_deg: float
) -> tuple[Ints, Ints, Array]:
    """Answers, flat in `(L, P)`, of pixels `beside` each other, and the angle between the lights.

    It is taken about the mean direction of the two: how far the hair turns from one to the other
    is then told by their answers alone, and not by how well the two directions are known.
    """
    places, count = beside(observed), observed.valid.shape[1]
    both, pairs = places.T.ravel(), len(places)
    one, other = fibres.mean_tangent()[places.T]
    sign = np.where((one * other).sum(axis=1, keepdims=True) < 0, -1.0, 1.0)
    mean = one + sign * other
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    found = near_mirror(
        observed.where(both), fibres.where(both), tilt_deg, WINDOW, np.concatenate([mean, mean])
    )
    first, second = found.near[:, :pairs], found.near[:, pairs:]
    pair, i, j = np.nonzero(first.T[:, :, None] & second.T[:, None, :])
    apart = i != j  # two answers to one light have the noise of that light's frame in common
    pair, i, j = pair[apart], i[apart], j[apart]
    angle = np.abs(found.deviation[i, pair] - found.deviation[j, pairs + pair])
    return i * count + places[pair, 0], j * count + places[pair, 1], angle


def parts_of(observed: Observed) -> Ints:
    """Part of the view's hair `(P,)` that each pixel lies in: thirds by column, thirds of those."""
    row, column = np.divmod(observed.pixels, observed.camera.width)
    out = np.zeros(len(row), np.int64)
    for i, third in enumerate(np.array_split(np.argsort(column, kind="stable"), SIDE)):
        for j, part in enumerate(
            np.array_split(third[np.argsort(row[third], kind="stable")], SIDE)
        ):
            out[part] = SIDE * i + j
    return out


def _relative(total: Array, count: Array) -> Array:
    mean = total / np.maximum(count, 1)
    return np.asarray(mean / np.maximum(mean.mean(axis=1, keepdims=True), 1e-30))


def _bin(values: Array, edges: Array) -> Ints:
    return np.clip(np.digitize(values, edges) - 1, 0, len(edges) - 2)


def _summed(bin_of: Ints, values: Array, bins: int) -> Array:
    return np.asarray(np.bincount(bin_of, values, SIDE**2 * bins).reshape(SIDE**2, bins), float)

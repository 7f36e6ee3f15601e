"""Responses of pixels to lights near their mirror direction, and their products over pairs.

Measured in the same way on a capture and on renderings of known roughness, for
`light_correlation`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import pairwise
from typing import Self

import numpy as np

from appearance.observations import Observed
from appearance.sun_fit.hair_parts import SIDE, bin_of, parts_of, summed
from appearance.sun_fit.mirror_samples import near_mirror
from appearance.sun_fit.visible_fibres import VisibleFibres
from reconstruction.arrays import AnyFloats, Array, Floats, Ints

WINDOW = np.pi / 3
"""Largest deviation of lights from the mirror direction."""
EDGES = np.radians([0, 8, 16, 24, 32, 40, 50, 60, 75, 90, 120])
"""Bins of |θ_i − θ_i'| of two lights."""
INNER = slice(4, 26)
"""Bins of the deviation into which no shift brings values from outside the window."""
SHIFTS = np.radians(np.arange(0, 31, 3))
"""Of highlights, root mean square, that profiles are read with."""
_DEVIATIONS = np.linspace(-WINDOW, WINDOW, 31)


@dataclass(frozen=True, eq=False)
class Highlight:
    """Sums over `J` parts of the hair, `SIDE`² of each view.

    `products (J, 10)` of a pixel's responses to two lights, over `EDGES`, and `pairs` how many;
    `values (J, 30)` of its responses over the signed deviation from the mirror direction, and
    `samples` how many.
    """

    products: Array
    pairs: Array
    values: Array
    samples: Array

    @classmethod
    def joined(cls, views: Sequence[Self]) -> Self:
        """The highlights of several views as one."""
        none = (np.zeros((0, len(edges) - 1)) for edges in 2 * [EDGES] + 2 * [_DEVIATIONS])
        return cls(
            *(
                np.concatenate([empty, *(getattr(view, f.name) for view in views)])
                for f, empty in zip(fields(cls), none, strict=True)
            )
        )

    def correlation(self, parts: Array) -> Array:
        """Mean products over `EDGES`, relative to their mean `(M, 10)`; `parts (M, J)` weigh."""
        return _relative(parts @ self.products, parts @ self.pairs)

    def profiles(self, parts: Array) -> Array:
        """Mean responses over deviation if shifted at random `(M, S, 11)`, relative to their mean.

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
    `scale (L, P)` turns radiance into the fibre's response, 1/sr.
    """

    sample: Ints
    bin_of_sample: Ints
    first: Ints
    second: Ints
    bin_of_pair: Ints
    scale: Array

    @classmethod
    def of(
        cls, observed: Observed, fibres: VisibleFibres, *, tilt_deg: float, channel: int
    ) -> LightPairs:
        """Those of `observed`, whose pixels show `fibres`."""
        found = near_mirror(observed, fibres, tilt_deg, WINDOW)
        part, count = parts_of(observed), observed.valid.shape[1]
        deviation = found.deviation.ravel()
        pixel, light = np.nonzero(found.near.T)
        sample = light * count + pixel
        ends = np.searchsorted(pixel, np.arange(count + 1))
        pairs = [np.stack(np.triu_indices(b - a, 1)) + a for a, b in pairwise(ends)]
        i, j = sample[np.concatenate(pairs, axis=1)]
        angle = np.abs(deviation[i] - deviation[j])
        near = angle < EDGES[-1]
        i, j, angle = i[near], j[near], angle[near]
        return cls(
            sample,
            part[pixel] * (len(_DEVIATIONS) - 1) + bin_of(deviation[sample], _DEVIATIONS),
            i,
            j,
            part[i % count] * (len(EDGES) - 1) + bin_of(angle, EDGES),
            found.squared
            / np.maximum(found.shines[..., channel], 1e-12)
            / np.maximum(fibres.share, 1e-12),
        )

    def highlight(self, one: AnyFloats, other: AnyFloats) -> Highlight:
        """The highlight in the radiances `one`, `other (L, P)` of the same pixels.

        Products of two independent renderings have no noise bias.
        """
        a, b = (np.asarray(self.scale * x, float).ravel() for x in (one, other))
        i, j, k = self.first, self.second, self.sample
        of_pairs, of_samples = (SIDE**2, len(EDGES) - 1), (SIDE**2, len(_DEVIATIONS) - 1)
        return Highlight(
            summed(self.bin_of_pair, 0.5 * (a[i] * b[j] + a[j] * b[i]), of_pairs),
            summed(self.bin_of_pair, np.ones(len(i)), of_pairs),
            summed(self.bin_of_sample, 0.5 * (a[k] + b[k]), of_samples),
            summed(self.bin_of_sample, np.ones(len(k)), of_samples),
        )


@dataclass(frozen=True, eq=False)
class Highlights:
    """Reads the highlights of `views` in one colour `channel`."""

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


def _relative(total: Array, count: Array) -> Array:
    mean = total / np.maximum(count, 1)
    return np.asarray(mean / np.maximum(mean.mean(axis=1, keepdims=True), 1e-30))

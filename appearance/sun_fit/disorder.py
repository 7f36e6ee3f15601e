"""By how much single hairs turn beyond the strands that stand for them.

Reconstructed strands may be smoother than hair: a pixel of theirs then mixes fewer directions. Two
pixels beside each other show other hairs, whose directions differ by as much as single hairs turn,
over the square root of how many a pixel shows. So the product of their answers to two lights falls
less with the angle between the lights than that of one pixel's, whatever the strands' own
directions are off: the angle is taken about the mean direction of the two. It falls the less the
further they lie apart, too, as the hair's direction changes; followed back to no distance
(`Likeness.of`), what is left is single hairs'.

The strands, as they are and `disordered`, say how much that is for every turn. They need not be
rendered for that: what a pixel answers at first hand is the mean lobe of the fibres that it sees,
and light between fibres leaves a share of what pixels are unlike, which two renderings tell
(`direct_share`). Answers are relative to a pixel's own mean: shadows and paler hair make pixels
darker, not unlike.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from appearance.observations import Observed
from appearance.sun_fit.hair_parts import (
    FEWEST_PAIRS,
    SIDE,
    bin_of,
    errors,
    leaving_out,
    parts_of,
    summed,
)
from appearance.sun_fit.highlights import EDGES, WINDOW, Highlight
from appearance.sun_fit.mirror_samples import near_mirror
from appearance.sun_fit.visible_fibres import VisibleFibres
from reconstruction import Strands
from reconstruction.arrays import AnyFloats, Array, Ints

BESIDE = (2, 4)
"""Pixels that two pixels lie apart, in a row or a column, whose likeness is asked for.

As far as a lens's blur and a filter do not mix them; twice, for what changes with the distance.
"""
DARK = 0.1
"""Of the mean answer of all pixels, what a pixel's counts as at least."""
TOLD_DEG = 8.0
"""Degrees from which on turns are told, where surely no less: smaller ones hardly show."""
LEAST_OFF = 0.005
"""What a likeness is off by at least: as much as draws of turned strands differ by."""
_APART = (0, *BESIDE)
_WAVE = 0.06  # metres of strand: about the pitch of wavy hair
_SQUARES = 2001  # that a belief is computed at
_BELIEVED = 100  # that stand for it


@dataclass(frozen=True)
class Disorder:
    """What is known of by how much single strands turn beyond those that are there.

    `squares (K,)` of the turn, degrees² root mean square, one as likely as another, ascending, up
    to that of `most`, what was tried; `beyond`: pixels surely differ by more than those turned so.
    """

    squares: tuple[float, ...]
    most: float
    beyond: bool = False

    @property
    def degrees(self) -> float:
        """By how much, root mean square over what is believed."""
        return float(np.mean(self.squares)) ** 0.5

    @property
    def low(self) -> float:
        """The lower end of an interval of 95 %, degrees."""
        return float(np.percentile(self.squares, 2.5)) ** 0.5

    @property
    def high(self) -> float:
        """The upper end of that interval."""
        return float(np.percentile(self.squares, 97.5)) ** 0.5

    @property
    def told(self) -> bool:
        """Whether single hairs surely turn: the fibres' β_M is less than the one to render with."""
        return self.low > TOLD_DEG

    def figures(self) -> dict[str, Any]:
        """Those of a report."""
        names = ("degrees", "low", "high", "most", "beyond")
        return {name: getattr(self, name) for name in names}


def disordered(strands: Strands, angle: float, seed: int) -> Strands:
    """`strands` that each wave on their own, so that tangents turn by `angle` (radians RMS)."""
    rng, strand = np.random.default_rng(seed), strands.strand_of_point
    points, tangents = strands.points.astype(float), strands.tangents().astype(float)
    step = np.linalg.norm(np.diff(points, axis=0, prepend=points[:1]), axis=1)
    arc = np.cumsum(step)
    turns = 2 * np.pi * (arc - arc[strands.offsets[:-1]][strand]) / _WAVE
    across = np.cross(tangents, rng.normal(size=(len(strands), 3))[strand])
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    for direction in (across, np.cross(tangents, across)):
        phase = rng.uniform(0, 2 * np.pi, len(strands))[strand]
        wave = np.sin(turns + phase) - np.sin(phase)
        points += angle * _WAVE / (2 * np.pi) * wave[:, None] * direction
    return replace(strands, points=points.astype(np.float32))


@dataclass(frozen=True, eq=False)
class Likeness:
    """Sums over `J` parts of the hair, `SIDE`² of each view.

    `products (J, 3, 10)` of answers to two lights, over `EDGES`, and `pairs` how many: of one
    pixel, and of two that lie either of `BESIDE` apart.
    """

    products: Array
    pairs: Array

    @classmethod
    def joined(cls, views: Sequence[Self]) -> Self:
        """The sums of several views as one; of none, nothing."""
        none = np.zeros((0, len(_APART), len(EDGES) - 1))
        products = np.concatenate([none, *(view.products for view in views)])
        return cls(products, np.concatenate([none, *(view.pairs for view in views)]))

    @property
    def told(self) -> Array:
        """How many pairs `(J,)` tell of two pixels, at the distance that has fewer."""
        return np.asarray(self.pairs[:, 1:].sum(axis=2).min(axis=1))

    def of(self, parts: Array) -> Array:
        """How far other hair at one place answers as the same does `(M,)`; `parts (M, J)` weigh.

        The slope of two pixels' mean products over those of one, bin by bin, is 1 where both have
        the same highlight, 0 where they are strangers. A line through those of `BESIDE` goes on to
        no distance.
        """
        count = np.maximum(np.tensordot(parts, self.pairs, 1), 1)
        one, *two = (np.tensordot(parts, self.products, 1) / count).swapaxes(0, 1)
        off = one - one.mean(axis=1, keepdims=True)
        spread = np.maximum((off**2).sum(axis=1), 1e-300)
        near, far = ((off * mean).sum(axis=1) / spread for mean in two)
        return np.asarray(near + (near - far) * BESIDE[0] / (BESIDE[1] - BESIDE[0]))


@dataclass(frozen=True, eq=False)
class PixelPairs:
    """`M` pairs of a view's answers to two lights, of one pixel or of two.

    `at (N,)` says which answers, flat in `(L, P)`, and `pixel (N,)` whose they are; `first` and
    `second (M,)` are places in them. `bin (M,)` counts through the bins of the parts of the hair,
    and of the distances in each.
    """

    at: Ints
    pixel: Ints
    first: Ints
    second: Ints
    bin: Ints

    @classmethod
    def of(cls, observed: Observed, fibres: VisibleFibres, tilt_deg: float) -> PixelPairs:
        """Those of `observed`, whose pixels see `fibres`."""
        part, count = parts_of(observed), observed.valid.shape[1]
        found: list[tuple[Ints, Ints, Ints]] = []
        for number, apart in enumerate(_APART):
            one, other, angle = _pairs(observed, fibres, tilt_deg, apart)
            place = len(_APART) * part[one % max(count, 1)] + number
            found.append((one, other, place * (len(EDGES) - 1) + bin_of(angle, EDGES)))
        first, second, bins = (np.concatenate(each) for each in zip(*found, strict=True))
        at, place = np.unique(np.concatenate([first, second]), return_inverse=True)
        first, second = np.split(place, 2)
        return cls(at, at % max(count, 1), first, second, bins)

    def likeness(self, one: AnyFloats, other: AnyFloats) -> Likeness:
        """That of the answers `one`, `other (N,)`, 1/sr up to a factor, `at` the same places.

        They are the same twice, or by two halves of what a pixel sees: mean products are then free
        of their noise.
        """
        a, b = self._relative(one), self._relative(other)
        i, j, shape = self.first, self.second, (SIDE**2, len(_APART), len(EDGES) - 1)
        products = 0.5 * (a[i] * b[j] + a[j] * b[i])
        return Likeness(summed(self.bin, products, shape), summed(self.bin, np.ones(len(i)), shape))

    def _relative(self, answers: AnyFloats) -> Array:
        """To each pixel's mean."""
        if not len(self.at):
            return np.zeros(0)
        count = np.bincount(self.pixel)
        mean = np.bincount(self.pixel, answers) / np.maximum(count, 1)
        least = max(DARK * float(np.average(mean, weights=count)), 1e-300)
        return np.asarray(answers / np.maximum(mean, least)[self.pixel])


def direct_share(direct: Highlight, whole: Highlight) -> float:
    """How much of what two pixels are unlike is left where light between fibres adds to it.

    By renderings of `direct` light and of the `whole`. What a fibre sends on from others points as
    its own highlight does, but comes of many hairs, alike for pixels beside each other: the product
    of one pixel's answers falls by more, and the difference of two pixels' is the same.
    """
    of_direct, of_whole = (
        mean - mean.mean()
        for h in (direct, whole)
        for mean in [h.products.sum(axis=0) / np.maximum(h.pairs.sum(axis=0), 1)]
    )
    return float((of_direct * of_whole).sum() / max((of_whole**2).sum(), 1e-300))


def match_disorder(
    captured: Likeness, turned: Iterable[tuple[float, Likeness]], share: float = 1.0
) -> Disorder | None:
    """The disorder of strands whose pixels are as alike as the `captured` ones.

    Of what the `turned` are unlike, `share` is left in pictures (`direct_share`). Between the
    `turned`, which ascend from 0, likeness falls linearly with the square of the turn. What is
    believed follows by Bayes' rule from the captured likeness, whose error is the jackknife's over
    parts of the hair, or what the views' differ by. Beforehand hair turns no more than its strands
    as likely as not, and any square up to the last is as likely as another if it does. None where
    too few pixels lie `BESIDE` each other, and nothing is computed then, or where turns make pixels
    no less alike.
    """
    if captured.told.sum() < FEWEST_PAIRS:
        return None
    chosen, left_out = leaving_out(captured.told)
    found = [(degrees, 1 - share * (1 - likeness.of(chosen))) for degrees, likeness in turned]
    squares = np.array([degrees**2 for degrees, _ in found])
    falling = np.minimum.accumulate([likeness for _, likeness in found])
    if falling[-1, 0] >= falling[0, 0]:
        return None
    seen, expected = captured.of(chosen), falling[:, 0]
    nearest = np.interp(-seen[0], -expected, squares)
    unlike = seen - [np.interp(nearest, squares, curve) for curve in falling.T]
    off = max(*errors(unlike, left_out), LEAST_OFF)
    each = np.linspace(0, squares[-1], _SQUARES)
    chi2 = ((seen[0] - np.interp(each, squares, expected)) / off) ** 2
    likelihood = np.exp(0.5 * (chi2.min() - chi2))
    belief = np.cumsum(likelihood / len(each) + np.where(each == 0, likelihood[0], 0))
    believed = np.interp((np.arange(_BELIEVED) + 0.5) / _BELIEVED * belief[-1], belief, each)
    beyond = bool(seen[0] + 2 * off < expected[-1])
    return Disorder(tuple(believed.tolist()), float(squares[-1] ** 0.5), beyond)


def beside(observed: Observed, apart: int) -> Ints:
    """Places `(N, 2)` in `observed.pixels` of two that lie `apart`, right or below; 0: of each."""
    pixels, width = observed.pixels, observed.camera.width
    if not apart:
        return np.stack([np.arange(len(pixels))] * 2, axis=1)
    order = np.argsort(pixels, kind="stable")
    found = []
    for step, fits in ((apart, pixels % width + apart < width), (apart * width, True)):
        at = np.minimum(np.searchsorted(pixels[order], pixels + step), len(pixels) - 1)
        there = np.flatnonzero((pixels[order[at]] == pixels + step) & fits)
        found.append(np.stack([there, order[at[there]]], axis=1))
    return np.concatenate(found)


def _pairs(
    observed: Observed, fibres: VisibleFibres, tilt_deg: float, apart: int
) -> tuple[Ints, Ints, Array]:
    """Answers, flat in `(L, P)`, of pixels that lie `apart`, and the angle between the lights.

    It is taken about the mean direction of the two: how far the hair turns from one to the other
    is then told by their answers alone, and not by how well the two directions are known.
    """
    places, count = beside(observed, apart), observed.valid.shape[1]
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
    # two answers to one light have the noise of that light's frame in common
    of_two = i != j if apart else i < j
    pair, i, j = pair[of_two], i[of_two], j[of_two]
    angle = np.abs(found.deviation[i, pair] - found.deviation[j, pairs + pair])
    near = angle < EDGES[-1]
    pair, i, j = pair[near], i[near], j[near]
    return i * count + places[pair, 0], j * count + places[pair, 1], angle[near]

"""Roughness from highlights, by strands whose tangents are not exact.

An error ε of a tangent's inclination moves the pixel's whole highlight by 2ε, so the mean profile
over many pixels is wider than the lobe and its roughness too large. The product of a pixel's
answers to two lights near its mirror direction, averaged over the angle Δ between them, does not
ask where the highlight is: its width over Δ is the lobe's. For broad lobes, where Δ does not reach
far enough, the profile decides, with the spread of its shifts as an unknown. Renderings of known
roughness are measured in the same way; the roughness is where theirs meet the capture's.

Reconstructed strands are smoother than hair: a pixel of theirs mixes fewer directions, which the
products do see. By how much is told by pixels that lie beside each other: how much less the product
of their answers falls with the angle than that of one pixel's (`Highlight.likeness`) hardly depends
on the roughness, but falls with every turn of single strands. The renderings are of strands that
are `disordered` until their likeness is the capture's (`match_disorder`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import pairwise
from typing import Self

import numpy as np
from scipy.interpolate import PchipInterpolator

from appearance.observations import Observed
from appearance.sun_fit.mirror_samples import near_mirror
from appearance.sun_fit.visible_fibres import VisibleFibres
from reconstruction import Strands
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
FEWEST_PAIRS = 200
"""Pairs of lights, over all pixels, without which there is no answer."""
FEWEST_OF_VIEW = 1000
"""Pairs of lights that a single view's answer needs to be compared with others."""
WIDEST = 1.5
"""Ratio of the interval's ends above which a roughness is called uncertain."""
LARGEST_ERROR = 0.1
WORST_MISFIT = 3.0
_DEVIATIONS = np.linspace(-WINDOW, WINDOW, 31)
_INNER = slice(4, 26)  # a shift brings in nothing unknown there
_SHIFTS = np.radians(np.arange(0, 31, 3))
_FLOOR = 0.02  # what a mean of a bin is off by at least, of the mean over bins
_BETWEEN_RENDERINGS = 0.015  # error of log β_M by interpolation
_STEPS = 400
_WAVE = 0.06  # metres of strand: about the pitch of wavy hair


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
        """The highlights of several views as one."""
        names = [f.name for f in fields(cls)]
        return cls(*(np.concatenate([getattr(v, name) for v in views]) for name in names))

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

        `S` are normal shifts of `_SHIFTS`.
        """
        mean = _relative(parts @ self.values, parts @ self.samples)
        middle = 0.5 * (_DEVIATIONS[1:] + _DEVIATIONS[:-1])
        spread = np.maximum(_SHIFTS, 1e-3)[:, None, None]
        kernel = np.exp(-0.5 * ((middle[:, None] - middle) / spread) ** 2)
        kernel /= kernel.sum(axis=2, keepdims=True)
        inner = (mean @ kernel.swapaxes(1, 2)).swapaxes(0, 1)[..., _INNER]
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
        own = sum(pair.shape[1] for pair in pairs)
        pairs += [
            np.stack(np.meshgrid(np.arange(*ends[p : p + 2]), np.arange(*ends[q : q + 2]))).reshape(
                2, -1
            )
            for p, q in beside(observed)
        ]
        i, j = sample[np.concatenate(pairs, axis=1)]
        angle = np.abs(deviation[i] - deviation[j])
        # two answers to one light have the noise of that light's frame in common
        kept = (angle < EDGES[-1]) & (i // count != j // count)
        own = int(kept[:own].sum())
        i, j, angle = (x[kept] for x in (i, j, angle))
        shines = [light.intensity_towards(found.middle)[:, channel] for light in observed.lights]
        return cls(
            sample,
            part[pixel] * (len(_DEVIATIONS) - 1) + _bin(deviation[sample], _DEVIATIONS),
            i,
            j,
            part[i % count] * (len(EDGES) - 1) + _bin(angle, EDGES),
            own,
            found.squared / np.maximum(shines, 1e-12) / np.maximum(fibres.share, 1e-12),
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


@dataclass(frozen=True)
class Disorder:
    """By how much single strands turn beyond those that were rendered.

    `degrees`, root mean square, with its standard error, up to `most`: what was rendered.
    """

    degrees: float
    error: float
    most: float

    @property
    def share(self) -> float:
        """Error of its square, relative: 1 at most."""
        return min(2 * self.error / self.degrees, 1.0) if self.degrees > 0 else 1.0


@dataclass(frozen=True)
class Roughness:
    """A roughness with what is known of its error.

    `error` is the standard error of log β_M: the larger of those over parts of the hair (`parts`)
    and between views, and `systematic`. `low`, `high` are the ends of an interval of about 95 %,
    inside `range`, that of the renderings. `views` are the answers of single views that have pairs
    enough. `misfit` is the χ² of the best match per degree of freedom. `tangents_deg` is how far
    inclinations are off, root mean square, more than in the renderings, and `tangents_error_deg`
    its standard error. `disorder` is by how much the rendered strands were disordered; None where
    no two pixels beside each other told.
    """

    beta_m: float
    error: float
    low: float
    high: float
    range: tuple[float, float]
    parts: float
    views: tuple[float, ...]
    misfit: float
    tangents_deg: float
    tangents_error_deg: float
    systematic: float = 0.0
    disorder: Disorder | None = None

    def after(self, other: Roughness, disorder: Disorder | None) -> Roughness:
        """This one, of strands of that `disorder`, with `other`, of the strands as they are.

        What lies between the two answers, which grows with the square of the disorder, joins the
        error by the disorder's; half of it where that was not measured. The tangents' error is that
        of `other`.
        """
        share = 0.5 if disorder is None else disorder.share
        systematic = share * abs(float(np.log(self.beta_m / other.beta_m)))
        wider = np.exp(np.hypot(self.error, systematic) * 2 - self.error * 2)
        return replace(
            self,
            error=float(np.hypot(self.error, systematic)),
            low=float(max(self.low / wider, self.range[0])),
            high=float(min(self.high * wider, self.range[1])),
            tangents_deg=other.tangents_deg,
            tangents_error_deg=other.tangents_error_deg,
            systematic=systematic,
            disorder=disorder,
        )

    def warnings(self) -> list[str]:
        """What a user has to know before believing it, a sentence each."""
        said, either = [], f"{self.low:.2g} to {self.high:.2g}"
        least, most = self.range
        if self.low <= least * 1.001 or self.high >= most / 1.001:
            said.append(
                f"β_M {self.beta_m:.2g} is known to lie in {either} only, which reaches an end of "
                f"the range that was rendered, {least:g} to {most:g}"
            )
        elif self.high > WIDEST * self.low:
            said.append(f"β_M {self.beta_m:.2g} is uncertain: the highlight fits {either}")
        if np.sqrt(self.error**2 - self.systematic**2) > max(2 * self.parts, LARGEST_ERROR):
            views = ", ".join(f"{beta:.2g}" for beta in self.views)
            said.append(f"views disagree about β_M by more than their noise: {views}")
        if self.disorder is not None and self.disorder.degrees >= self.disorder.most:
            said.append(
                "pixels beside each other differ by more than strands turned by "
                f"{self.disorder.most:g}° do: β_M {self.beta_m:.2g} may be too large"
            )
        if self.misfit > WORST_MISFIT:
            said.append(
                f"no roughness fits the highlight (χ² {self.misfit:.1f} per degree of freedom): "
                "are the strands where the hair is?"
            )
        return said


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


def disordered(strands: Strands, angle: float, seed: int) -> Strands:
    """`strands` that each wave on their own, so that tangents turn by `angle` (radians RMS)."""
    rng, strand = np.random.default_rng(seed), strands.strand_of_point
    points, tangents = strands.points.astype(float), strands.tangents().astype(float)
    step = np.linalg.norm(np.diff(points, axis=0, prepend=points[:1]), axis=1)
    arc = np.cumsum(step)
    turns = 2 * np.pi * (arc - arc[strands.offsets[:-1]][strand]) / _WAVE
    across = np.cross(tangents, rng.normal(size=3))
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    for direction in (across, np.cross(tangents, across)):
        phase = rng.uniform(0, 2 * np.pi, len(strands))[strand]
        wave = np.sin(turns + phase) - np.sin(phase)
        points += angle * _WAVE / (2 * np.pi) * wave[:, None] * direction
    return replace(strands, points=points.astype(np.float32))


def match_disorder(
    captured: Highlight, rendered: Sequence[tuple[float, Highlight]]
) -> Disorder | None:
    """The disorder, degrees, whose rendered highlights are as alike as the `captured` ones.

    Between the `rendered`, which ascend from 0, a parabola. The error is the jackknife's over parts
    of the hair, or what the views' answers differ by. None where too few pixels lie `BESIDE` each
    other.
    """
    if captured.pairs_beside.sum() < FEWEST_PAIRS:
        return None
    nodes = np.array([degrees for degrees, _ in rendered])
    chosen, left_out = _chosen(captured.pairs_beside)
    curve = np.polyfit(nodes, np.stack([h.likeness(chosen) for _, h in rendered]), 2)
    x = np.linspace(0, nodes[-1], _STEPS)
    falling = np.minimum.accumulate(np.vander(x, 3) @ curve)
    answers = x[np.abs(falling - captured.likeness(chosen)).argmin(axis=0)]
    return Disorder(float(answers[0]), max(_errors(answers, left_out)), float(nodes[-1]))


def _chosen(pairs: Array) -> tuple[Array, int]:
    """Weights `(M, J)` of parts that have `pairs (J, B)`: of all, of all but one, of single views.

    And how many leave one out.
    """
    parts, there = len(pairs), pairs.sum(axis=1)
    left_out = (1 - np.eye(parts))[there > 0]
    views = np.kron(np.eye(parts // SIDE**2), np.ones(SIDE**2))
    views = views[views @ there >= FEWEST_OF_VIEW]
    return np.concatenate([np.ones((1, parts)), left_out, views]), len(left_out)


def match_roughness(captured: Highlight, rendered: Sequence[tuple[float, Highlight]]) -> Roughness:
    """The β_M whose rendered highlights are nearest the `captured` one.

    Between the `rendered` roughnesses, which ascend, each bin is interpolated monotonically in log
    β_M. Bins weigh by their scatter over parts of the hair; the error of the answer is the
    jackknife's over the same parts, or what the views' answers differ by where that is more. Raises
    `ValueError` where there are too few pairs of lights.
    """
    if (pairs := int(captured.pairs.sum())) < FEWEST_PAIRS:
        raise ValueError(
            f"only {pairs} pairs of lights lie near the mirror directions of hair pixels, fewer "
            f"than {FEWEST_PAIRS}: the roughness needs more lights, or more hair pixels"
        )
    nodes = np.log([beta for beta, _ in rendered])
    x = np.linspace(nodes[0], nodes[-1], _STEPS)
    chosen, left_out = _chosen(captured.pairs)
    jackknife = slice(1, left_out + 1)

    def distance(target: Array, family: Array) -> Array:
        """χ² `(_STEPS, M, ...)` between `target (M, B)` and renderings `(nodes, M, ..., B)`."""
        target = target.reshape(len(target), *[1] * (family.ndim - 3), -1)
        plain = family.reshape(*family.shape[:2], -1, target.shape[-1])[:, :, 0]
        nearest = np.argmin(((plain[:, 0] - target.reshape(len(target), -1)[0]) ** 2).sum(axis=1))
        off = (target.reshape(plain.shape[1:]) - plain[nearest])[jackknife]
        variance = (left_out - 1) * off.var(axis=0) + _FLOOR**2
        curves = PchipInterpolator(nodes, family, axis=0)(x)
        return np.asarray(((curves - target) ** 2 / variance).sum(axis=-1))

    by_correlation = distance(
        captured.correlation(chosen), np.stack([h.correlation(chosen) for _, h in rendered])
    )
    by_profile = distance(
        captured.profiles(chosen)[:, 0], np.stack([h.profiles(chosen) for _, h in rendered])
    )
    chi2 = by_correlation + by_profile.min(axis=2)
    best = np.array([_lowest(x, c) for c in chi2.T])
    profiles = by_profile[chi2.argmin(axis=0), np.arange(len(chosen))]
    shifts = np.array([_lowest(_SHIFTS, p) for p in profiles])
    answer, alone = best[0], best[left_out + 1 :]
    scatter, between = _errors(best, left_out)
    least = chi2[:, 0].min()
    bins = captured.pairs.shape[1] + (_INNER.stop - _INNER.start) // 2
    misfit = float(least / (bins - 4))
    error = float(np.hypot(max(scatter, between) * max(misfit, 1.0) ** 0.5, _BETWEEN_RENDERINGS))
    inside = x[chi2[:, 0] <= least + 4 * max(misfit, 1.0)]
    low, high = min(answer - 2 * error, inside[0]), max(answer + 2 * error, inside[-1])
    return Roughness(
        float(np.exp(answer)),
        error,
        float(np.exp(max(low, x[0]))),
        float(np.exp(min(high, x[-1]))),
        (rendered[0][0], rendered[-1][0]),
        scatter * max(misfit, 1.0) ** 0.5,
        tuple(np.exp(alone).tolist()),
        misfit,
        float(np.degrees(shifts[0]) / 2),
        float(np.degrees(max(_errors(shifts, left_out))) / 2),
    )


def _errors(answers: Array, parts: int) -> tuple[float, float]:
    """Standard errors of the first of `answers (N,)`: the jackknife's, and between views.

    The next `parts` of them leave out a part of the hair each; the rest are those of single views.
    """
    left_out, alone = answers[1 : parts + 1], answers[parts + 1 :]
    between = alone.std(ddof=1) / np.sqrt(len(alone)) if len(alone) > 1 else 0.0
    return float(np.sqrt((parts - 1) * left_out.var())), float(between)


def _relative(total: Array, count: Array) -> Array:
    mean = total / np.maximum(count, 1)
    return np.asarray(mean / np.maximum(mean.mean(axis=1, keepdims=True), 1e-30))


def _bin(values: Array, edges: Array) -> Ints:
    return np.clip(np.digitize(values, edges) - 1, 0, len(edges) - 2)


def _summed(bin_of: Ints, values: Array, bins: int) -> Array:
    return np.asarray(np.bincount(bin_of, values, SIDE**2 * bins).reshape(SIDE**2, bins), float)


def _lowest(x: Array, y: Array) -> float:
    """Where the sampled `y (N,)` is least over `x (N,)`, refined by a parabola."""
    k = int(y.argmin())
    if not 0 < k < len(x) - 1:
        return float(x[k])
    a, b, c = y[k - 1 : k + 2]
    bend = a - 2 * b + c
    return float(x[k] + (x[1] - x[0]) * (0.5 * (a - c) / bend if bend > 0 else 0.0))


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

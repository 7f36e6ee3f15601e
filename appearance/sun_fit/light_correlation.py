"""Roughness from highlights, by strands whose tangents are not exact.

An error ε of a tangent's inclination moves the pixel's whole highlight by 2ε, so the mean profile
over many pixels is wider than the lobe and its roughness too large. The product of a pixel's
answers to two lights near its mirror direction, averaged over the angle Δ between them, does not
ask where the highlight is: its width over Δ is the lobe's. For broad lobes, where Δ does not reach
far enough, the profile decides, with the spread of its shifts as an unknown. Renderings of known
roughness are measured in the same way; the roughness is where theirs meet the capture's.

Reconstructed strands may be smoother than hair: a pixel of theirs then mixes fewer directions,
which the products do see. The renderings for the fibres' own roughness are of strands as disordered
as the hair is (`disorder`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import PchipInterpolator

from appearance.bsdf.longitudinal import roughness_of_variance, variance_of_roughness
from appearance.sun_fit.disorder import Disorder
from appearance.sun_fit.hair_parts import FEWEST_PAIRS, errors, leaving_out
from appearance.sun_fit.highlights import INNER, SHIFTS, Highlight
from reconstruction.arrays import Array

WIDEST = 1.5
"""Ratio of the interval's ends above which a roughness is called uncertain."""
SURE = 0.87
"""Of a roughness, how low it may be without a warning that turns do not show."""
UNMEASURED = 1.5
"""Over the square of the turn that the tangents' error makes likely: how much it may be."""
LARGEST_ERROR = 0.1
WORST_MISFIT = 3.0
_FLOOR = 0.02  # what a mean of a bin is off by at least, of the mean over bins
_BETWEEN_RENDERINGS = 0.015  # error of log β_M by interpolation
_STEPS = 400


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

    def of_fibres(self, turned: Roughness, degrees: float, disorder: Disorder | None) -> Roughness:
        """That of the fibres of hair in `disorder`, of this one, by the strands as they are.

        `turned` is the answer of strands that are turned by so many `degrees`. What a turn adds to
        the lobe's variance grows with its square; the answer is the mean of log β_M over the
        squares that are believed, the interval holds 95 % of them and what either answer is off by.
        Turns that leave fibres less than the least roughness that was rendered are not believed;
        where pixels differ by more than those that were tried do, the interval reaches down to it.
        Where no disorder was measured, any square up to 1.5 times that of `degrees` is as likely.
        The tangents' error and the misfit are those of the strands as they are: such that wave by
        themselves fit a highlight less well than those that stand where the hair is.
        """
        if disorder is None:
            share = np.linspace(0, UNMEASURED, 100)
        else:
            share = np.array(disorder.squares) / degrees**2
        least, most = turned.range
        own, other = variance_of_roughness(np.array([self.beta_m, turned.beta_m]))
        v = np.minimum(own + (other - own) * share, variance_of_roughness(most))
        possible = v >= variance_of_roughness(least)
        v = v[possible] if possible.any() else variance_of_roughness([least])
        log_beta = np.log(roughness_of_variance(v))
        answer = float(log_beta.mean())
        weight = float(np.clip(share[possible].mean(), 0, 1)) if possible.any() else 1.0

        def mean(of: Callable[[Roughness], float]) -> float:
            return (1 - weight) * of(self) + weight * of(turned)

        down, up = (abs(answer - np.percentile(log_beta, q)) for q in (2.5, 97.5))
        low = answer - np.hypot(down, mean(lambda r: np.log(r.beta_m / r.low)))
        high = answer + np.hypot(up, mean(lambda r: np.log(r.high / r.beta_m)))
        to_low, to_high = (turned if weight > 0.5 else self).ends()
        if to_low or possible.mean() < 0.5 or (disorder is not None and disorder.beyond):
            low = np.log(least)
        low, high = max(low, np.log(least)), np.log(most) if to_high else min(high, np.log(most))
        alone = mean(lambda r: r.error)
        error = float(max(np.hypot(alone, log_beta.std()), 0.5 * (answer - low)))
        return replace(
            self,
            beta_m=float(np.exp(answer)),
            error=error,
            low=float(np.exp(low)),
            high=float(np.exp(high)),
            range=turned.range,
            parts=mean(lambda r: r.parts),
            views=tuple(view * float(np.exp(answer)) / self.beta_m for view in self.views),
            systematic=float(np.sqrt(error**2 - alone**2)),
            disorder=disorder,
        )

    def ends(self) -> tuple[bool, bool]:
        """Whether the interval reaches the lower and the upper end of what was rendered."""
        return self.low <= self.range[0] * 1.001, self.high >= self.range[1] / 1.001

    def warnings(self) -> list[str]:
        """What a user has to know before believing it, a sentence each."""
        said, either = [], f"{self.low:.2g} to {self.high:.2g}"
        (least, most), d = self.range, self.disorder
        unsure = d is not None and not d.told and self.low < SURE * self.beta_m
        if any(self.ends()):
            said.append(
                f"β_M {self.beta_m:.2g} is known to lie in {either} only, which reaches an end of "
                f"the range that was rendered, {least:.2g} to {most:.2g}"
            )
        elif self.high > WIDEST * self.low and not unsure:
            said.append(f"β_M {self.beta_m:.2g} is uncertain: the highlight fits {either}")
        if np.sqrt(self.error**2 - self.systematic**2) > max(2 * self.parts, LARGEST_ERROR):
            views = ", ".join(f"{beta:.2g}" for beta in self.views)
            said.append(f"views disagree about β_M by more than their noise: {views}")
        turns = "single hairs turn more than the strands"
        if d is not None and d.told:
            said.append(
                f"{turns}, by {d.low:.0f} to {d.high:.0f}°, by what pixels beside each other tell: "
                f"the fibres' β_M, {self.beta_m:.2g} ({either}), stands on that"
            )
        elif d is not None and unsure:
            said.append(
                f"pixels beside each other hardly tell by how much {turns}, {d.low:.0f} to "
                f"{d.high:.0f}°: the fibres' β_M, {self.beta_m:.2g}, may be {either}"
            )
        if d is not None and d.beyond:
            said.append(
                "pixels beside each other differ by more than strands turned by "
                f"{d.most:g}° do, the most that are told apart: β_M {self.beta_m:.2g} is uncertain"
            )
        if self.misfit > WORST_MISFIT:
            said.append(
                f"no roughness fits the highlight (χ² {self.misfit:.1f} per degree of freedom): "
                "are the strands where the hair is?"
            )
        return said


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
    chosen, left_out = leaving_out(captured.pairs.sum(axis=1))
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
    shifts = np.array([_lowest(SHIFTS, p) for p in profiles])
    answer, alone = best[0], best[left_out + 1 :]
    scatter, between = errors(best, left_out)
    least = chi2[:, 0].min()
    bins = captured.pairs.shape[1] + (INNER.stop - INNER.start) // 2
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
        float(np.degrees(max(errors(shifts, left_out))) / 2),
    )


def _lowest(x: Array, y: Array) -> float:
    """Where the sampled `y (N,)` is least over `x (N,)`, refined by a parabola."""
    k = int(y.argmin())
    if not 0 < k < len(x) - 1:
        return float(x[k])
    a, b, c = y[k - 1 : k + 2]
    bend = a - 2 * b + c
    return float(x[k] + (x[1] - x[0]) * (0.5 * (a - c) / bend if bend > 0 else 0.0))

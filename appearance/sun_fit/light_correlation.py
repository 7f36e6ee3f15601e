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

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import PchipInterpolator

from appearance.sun_fit.disorder import Disorder
from appearance.sun_fit.hair_parts import FEWEST_PAIRS, errors, leaving_out
from appearance.sun_fit.highlights import INNER, SHIFTS, Highlight
from reconstruction.arrays import Array

WIDEST = 1.5
"""Ratio of the interval's ends above which a roughness is called uncertain."""
SURE = 0.87
"""Of a roughness, how low it may be for turns that do not show without a warning."""
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

    def after(self, other: Roughness, disorder: Disorder | None) -> Roughness:
        """This one, of strands of that `disorder`, with `other`, of the strands as they are.

        What lies between the two answers grows with the square of the disorder. Of it as much is
        taken as the disorder is known, three quarters where that was not measured: the mean of what
        it may be, if none is as likely beforehand as what was measured. Its spread joins the error.
        The tangents' error and the misfit are those of `other`: strands that wave by themselves fit
        a highlight less well than those that stand where the hair is.
        """
        trust = 0.75 if disorder is None else disorder.trust
        change = float(np.log(self.beta_m / other.beta_m))
        systematic = abs(change) * (1 - trust) ** 0.5
        back = float(np.exp((trust - 1) * change))
        wider = np.exp(np.hypot(self.error, systematic) * 2 - self.error * 2)
        return replace(
            self,
            beta_m=back * self.beta_m,
            error=float(np.hypot(self.error, systematic)),
            low=float(max(back * self.low / wider, self.range[0])),
            high=float(min(back * self.high * wider, self.range[1])),
            tangents_deg=other.tangents_deg,
            tangents_error_deg=other.tangents_error_deg,
            misfit=other.misfit,
            systematic=systematic,
            disorder=disorder,
        )

    def or_less(self, turned: Roughness, disorder: Disorder) -> Roughness:
        """This one, of strands as they are, where hair may be more disordered, which is not told.

        `turned` is the answer of strands as disordered as the hair may be: how low this one may be.
        """
        low = min(self.low, turned.beta_m)
        error = max(self.error, 0.5 * float(np.log(self.beta_m / low)))
        systematic = float(np.sqrt(error**2 - self.error**2))
        return replace(self, low=low, error=error, systematic=systematic, disorder=disorder)

    def warnings(self) -> list[str]:
        """What a user has to know before believing it, a sentence each."""
        said, either = [], f"{self.low:.2g} to {self.high:.2g}"
        least, most = self.range
        if self.low <= least * 1.001 or self.high >= most / 1.001:
            said.append(
                f"β_M {self.beta_m:.2g} is known to lie in {either} only, which reaches an end of "
                f"the range that was rendered, {least:.2g} to {most:.2g}"
            )
        elif self.high > WIDEST * self.low:
            said.append(f"β_M {self.beta_m:.2g} is uncertain: the highlight fits {either}")
        if np.sqrt(self.error**2 - self.systematic**2) > max(2 * self.parts, LARGEST_ERROR):
            views = ", ".join(f"{beta:.2g}" for beta in self.views)
            said.append(f"views disagree about β_M by more than their noise: {views}")
        d = self.disorder
        if d is not None and d.told:
            said.append(
                f"single hairs turn by {d.degrees:.0f}° (at least {d.least:.0f}°) more than the "
                "strands, by what pixels beside each other tell: the fibres' β_M, "
                f"{self.beta_m:.2g} ({either}), stands on that"
            )
        elif d is not None and self.low < SURE * self.beta_m:
            said.append(
                f"pixels beside each other do not tell whether single hairs turn by up to "
                f"{min(d.degrees + d.error, d.most):.0f}° more than the strands: the fibres' β_M, "
                f"{self.beta_m:.2g}, may be as low as {self.low:.2g}"
            )
        if d is not None and d.degrees >= d.most:
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

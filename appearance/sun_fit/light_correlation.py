"""Roughness from highlights, by strands whose tangents are not exact.

An error ε of a tangent's inclination shifts the pixel's highlight by 2ε, so the mean profile over
pixels is wider than the lobe. The product of a pixel's responses to two lights near its mirror
direction, averaged over the angle Δ between them, is independent of the highlight's position: its
width over Δ is the lobe's. Broad lobes exceed the range of Δ; there the profile decides, with the
spread of its shifts as an unknown. Renderings of known roughness are measured in the same way; the
result is the roughness whose renderings match.

Reconstructed strands may be smoother than hair; then the roughness that matches is larger than that
of the fibres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import PchipInterpolator

from appearance.sun_fit.hair_parts import FEWEST_PAIRS, errors, leaving_out
from appearance.sun_fit.highlights import INNER, SHIFTS, Highlight
from reconstruction.arrays import Array

WIDEST = 1.5
"""Ratio of the interval's ends above which a roughness is uncertain."""
LARGEST_ERROR = 0.1
WORST_MISFIT = 3.0
_FLOOR = 0.02  # what a mean of a bin is off by at least, of the mean over bins
_BETWEEN_RENDERINGS = 0.015  # error of log β_M by interpolation
_STEPS = 400


@dataclass(frozen=True)
class Roughness:
    """Roughness and its error.

    `error` is the standard error of log β_M: the larger of those over parts of the hair (`parts`)
    and between views. `low`, `high` are the ends of an interval of about 95 %, inside `range`, that
    of the renderings. `views` are the estimates of single views that have enough pairs. `misfit` is
    the χ² of the best match per degree of freedom. `tangents_deg` is how far inclinations are off,
    root mean square, more than in the renderings, and `tangents_error_deg` its standard error.
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

    def ends(self) -> tuple[bool, bool]:
        """Whether the interval reaches the lower and the upper end of what was rendered."""
        return self.low <= self.range[0] * 1.001, self.high >= self.range[1] / 1.001

    def limit(self) -> str:
        """The estimate's limit on reconstructed strands, one sentence."""
        return (
            "Fibres inside a pixel vary more than the reconstructed strands: "
            f"beta_m {self.beta_m:.2g} (95 % interval {self.low:.2g}–{self.high:.2g}) is the "
            "roughness to render these strands with, and may exceed that of a single fibre by a "
            "third (docs/explanation/sun_fit.md)."
        )

    def warnings(self) -> list[str]:
        """Reasons of uncertainty, one sentence each."""
        interval = f"95 % interval {self.low:.2g}–{self.high:.2g}"
        (least, most), out = self.range, []
        if any(self.ends()):
            out.append(
                f"beta_m {self.beta_m:.2g} ({interval}) reaches an end of the rendered range, "
                f"{least:.2g}–{most:.2g}: the true roughness may lie outside."
            )
        elif self.high > WIDEST * self.low:
            out.append(f"beta_m {self.beta_m:.2g} is uncertain: {interval}.")
        if self.error > max(2 * self.parts, LARGEST_ERROR):
            views = ", ".join(f"{beta:.2g}" for beta in self.views)
            out.append(f"Cameras disagree about beta_m by more than their noise: {views}.")
        if self.misfit > WORST_MISFIT:
            out.append(
                f"No roughness reproduces the highlight (χ² {self.misfit:.1f} per degree of "
                "freedom): check that the strands lie where the hair is."
            )
        return out


def match_roughness(captured: Highlight, rendered: Sequence[tuple[float, Highlight]]) -> Roughness:
    """The β_M whose rendered highlights are nearest the `captured` one.

    Between the `rendered` roughnesses, which ascend, each bin is interpolated monotonically in log
    β_M. Bins are weighted by their scatter over parts of the hair; the error is the larger of the
    jackknife's over the same parts and the views' spread. Raises `ValueError` for too few pairs of
    lights.
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

"""The response curve of a set whose fully lit frame is the sum of its single lights.

Debevec and Malik (SIGGRAPH 1997) recover a curve from known ratios of exposure; here the ratios
are those of additive light: D(all) = g · Σ D(single) for the curve D and a gain g per frame and
channel. A power with a black level and sRGB's curve are compared.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from reconstruction.arrays import Array, Bools, Floats, Ints
from reconstruction.files.colour import Curve, decoded

MODEL = 0.015
"""Relative error of a value that is not noise: motion, lamps that sag together."""
DARKEST, BRIGHTEST = -0.1, 1.3
"""Values, white at 1, between which curves are inverted."""
LOST = 0.05
"""Share of a sum that lights within the noise may have."""
JUMP = 0.3
"""Relative difference of a light's level between its own and the fully lit frame."""
DARK = 0.01
"""Highlights of a frame relative to the median frame's, below which its lamp was off."""
UNSURE = 0.05
"""Relative standard error of the exponent from which on it is undetermined."""
MOST_WRONG = 3
"""Lights of another level that are looked for."""
LEAST = 100
"""Samples below which nothing is estimated."""
_GRID = np.linspace(DARKEST, BRIGHTEST, 8192)


@dataclass(frozen=True, eq=False)
class SummedLights:
    """Values, white at 1, of places in a camera's frames.

    `singles (N, M, 3)` each under one light, for `seconds (N,)`; `lit (T, M, 3)` under all;
    `dark (M, 3)` under none, if there is such a frame. `noise` is the standard deviation of a
    value, `group (M,)` the part of the image that a place is in, `used (M, 3)` unsaturated values.
    """

    singles: Floats
    lit: Floats
    seconds: Array
    noise: float
    group: Ints
    used: Bools
    dark: Floats | None = None

    def light(self, values: Any, curve: Curve, black: float) -> Any:
        """Linear light of values."""
        return decoded((values - black) / (1 - black), curve).astype(float)

    def totals(self, curve: Curve, black: float) -> tuple[Array, Array]:
        """Sum of the single lights `(M, 3)`, and the light without lamps."""
        ambient = np.zeros(self.lit.shape[1:])
        if self.dark is not None:
            ambient = self.light(self.dark, curve, black)
        pairs = zip(self.singles, self.seconds, strict=True)
        return sum((self.light(v, curve, black) - ambient) / s for v, s in pairs), ambient

    def _sum_deviation(self, curve: Curve, black: float, total: Array) -> Array:
        """Standard deviation of the sum `(M, 3)`; infinite where the light of values within the
        noise, which are rounded and clipped alike, could change it."""
        variance, lost = np.zeros_like(total), np.zeros_like(total)
        for values, seconds in zip(self.singles, self.seconds, strict=True):
            here = self.light(values, curve, black)
            step = (self.light(values + self.noise, curve, black) - here) / seconds
            variance += step**2
            lost += np.where(values - black < 2 * self.noise, step, 0)
        return np.where(lost < LOST * total, np.sqrt(variance), np.inf)

    def gains(self, curve: Curve, black: float, total: Array, ambient: Array) -> Array:
        """Light of the fully lit frames over the sum `(T, 1, 3)`, medians."""
        ratio = (self.light(self.lit, curve, black) - ambient) / np.where(total > 0, total, np.nan)
        return np.asarray(np.nanmedian(np.where(self.used, ratio, np.nan), axis=1, keepdims=True))

    def deviations(self, curve: Curve, black: float) -> Array:
        """Expected standard deviation `(T, M, 3)` of `differences`."""
        total, ambient = self.totals(curve, black)
        slope = self.noise / np.maximum(
            self.light(self.lit + self.noise, curve, black) - self.light(self.lit, curve, black),
            1e-12,
        )
        of_sum = slope * self.gains(curve, black, total, ambient)
        of_sum = of_sum * self._sum_deviation(curve, black, total)
        return np.asarray(np.sqrt(self.noise**2 + (MODEL * self.lit) ** 2 + of_sum**2))

    def differences(self, curve: Curve, black: float) -> Array:
        """Value of the fully lit frames less that of the sum's light `(T, M, 3)`; 0 if not used."""
        total, ambient = self.totals(curve, black)
        light = self.gains(curve, black, total, ambient) * total + ambient
        value = np.interp(light, self.light(_GRID, curve, black), _GRID)
        return np.where(self.used, self.lit - value, 0.0)


@dataclass(frozen=True, eq=False)
class CurveFit:
    """An estimated curve and black level with standard errors, from the scatter between parts of
    the image; `sigma (T, M, 3)` are the expected deviations, infinite where nothing is used.
    `looseness` is the relative error of the exponent at this black level, by `sigma` alone."""

    curve: Curve
    black: float
    error: float
    black_error: float
    sigma: Array
    looseness: float


def fit_lights(sums: SummedLights) -> tuple[CurveFit, Array, Array] | None:
    """The curve, and each light's share `(N,)` of the fully lit frame over its own frame's, with
    standard errors: 1 where exposure and level agree, NaN for a dark frame.

    The curve is fitted again with lights of other levels corrected. None if it is undetermined.
    """
    factor = np.ones(len(sums.singles))
    while True:
        fit = _fit_curve(replace(sums, seconds=sums.seconds / factor))
        if fit is None:
            return None
        level, error = _light_levels(sums, fit)
        beyond = np.abs(level - 1) / np.maximum(JUMP, 6 * error)
        wrong = factor != 1
        worst = int(np.nanargmax(np.where(wrong, 0, beyond)))
        if beyond[worst] <= 1 or wrong.sum() == MOST_WRONG:
            return fit, np.where(wrong | np.isnan(level), level, 1.0), error
        wrong[worst] = True  # one at a time: a wrong level bends the curve, which alters the others
        factor = np.where(wrong, np.maximum(level, 1e-3), 1.0)


def _fit_curve(sums: SummedLights) -> CurveFit | None:
    """The curve that explains the fully lit frames; None where they do not determine it."""
    if len(sums.singles) < 2 or sums.used.any(axis=1).sum() < LEAST:
        return None
    power = _fit(sums, lambda x: (float(np.exp(x[0])), x[1]), ([0.0, 0.0], [0.8, 0.0]))
    places = (np.isfinite(power.sigma) & sums.used).any(axis=-1).sum()
    if places < LEAST or power.looseness > UNSURE:
        return None
    srgb = fit_black(sums, "srgb")
    clear = advantage(sums, power, srgb)
    if clear < -2 or (clear < 2 and abs(srgb.black) < abs(power.black)):
        return srgb
    assert isinstance(power.curve, float)  # fitted as a power
    straight = abs(power.curve - 1) < max(0.04, 2 * power.error)
    return replace(power, curve="linear") if straight else power


def fit_black(sums: SummedLights, curve: Curve) -> CurveFit:
    """The fit of a known `curve`."""
    return _fit(sums, lambda x: (curve, x[0]), ([0.0],))


def advantage(sums: SummedLights, fit: CurveFit, other: CurveFit) -> float:
    """By how many standard errors, between parts of the image, `fit` explains more than `other`."""
    cost = [_loss(sums.differences(f.curve, f.black) / fit.sigma) for f in (other, fit)]
    gain = np.array([(cost[0] - cost[1])[:, part].sum() for part in _parts(sums)])
    return float(gain.mean() / max(gain.std(ddof=1) / np.sqrt(len(gain)), 1e-12))


def misfit(sums: SummedLights, fit: CurveFit) -> float:
    """Median relative difference of the fully lit frames from the sum, in values."""
    relative = np.abs(sums.differences(fit.curve, fit.black)) / np.maximum(sums.lit, 1e-6)
    return float(np.median(relative[sums.used & np.isfinite(fit.sigma)]))


def _loss(residual: Array) -> Array:
    return np.asarray(2 * (np.sqrt(1 + residual**2) - 1))


def _parts(sums: SummedLights) -> list[Bools]:
    return [sums.group == k for k in np.unique(sums.group)]


def _fit(
    sums: SummedLights, model: Callable[[Any], tuple[Curve, float]], starts: tuple[list[float], ...]
) -> CurveFit:
    """Robust least squares; expected deviations are held while it iterates."""
    count = len(starts[0])
    low, high = [np.log(0.4), -0.01][-count:], [np.log(8.0), 0.25][-count:]
    best: Any = None
    for start in starts:
        x = np.array(start)
        for _ in range(2):
            sigma = sums.deviations(*model(x))
            found = least_squares(
                lambda x, sigma=sigma: (sums.differences(*model(x)) / sigma).ravel(),
                x, bounds=(low, high), loss="soft_l1", diff_step=1e-3, x_scale=[0.1, 0.01][-count:],
                max_nfev=20,
            )  # fmt: skip
            x = found.x
        if best is None or found.cost < best[0].cost:
            best = found, sigma
    found, sigma = best
    curve, black = model(found.x)
    residual = sums.differences(curve, black) / sigma
    weighted = residual / (1 + residual**2) ** 0.25
    jacobian = found.jac.reshape(*residual.shape, count)  # scaled by the loss
    parts = _parts(sums)
    scores = [np.einsum("tmcp,tmc->p", jacobian[:, p], weighted[:, p]) for p in parts]
    hessian = np.einsum("tmcp,tmcq->pq", jacobian, jacobian)
    inverse = np.linalg.inv(hessian + 1e-6 * np.eye(count))
    scatter = inverse @ np.einsum("gp,gq->pq", scores, scores) @ inverse
    scatter *= len(parts) / max(len(parts) - 1, 1)
    errors = np.sqrt(np.maximum(np.diag(scatter), np.diag(inverse)))
    loose = float((hessian[0, 0] + 1e-6) ** -0.5)
    of_gamma = float(np.exp(found.x[0]) * errors[0]) if count == 2 else 0.0
    return CurveFit(curve, float(black), of_gamma, float(errors[-1]), sigma, loose)


def _light_levels(sums: SummedLights, fit: CurveFit) -> tuple[Array, Array]:
    total, ambient = sums.totals(fit.curve, fit.black)
    sigma, used = fit.sigma[0], sums.used & np.isfinite(fit.sigma[0])
    gain = sums.gains(fit.curve, fit.black, total, ambient)[0]
    upper = sums.light(sums.lit[0] + np.where(used, sigma, 0), fit.curve, fit.black)
    target = sums.light(sums.lit[0], fit.curve, fit.black)
    deviation = np.maximum(upper - target, 1e-12)
    lights = np.array(
        [(sums.light(v, fit.curve, fit.black) - ambient) / s
         for v, s in zip(sums.singles, sums.seconds, strict=True)]
    )  # fmt: skip
    top = np.quantile(lights, 0.99, axis=(1, 2))
    bright = top > DARK * np.median(top)
    A = (gain * lights[bright] / deviation)[:, used].T
    b = ((target - ambient) / deviation)[used]
    near_one = 1e-6 * (np.square(A).sum() + 1)  # for lights that the places do not separate
    level, weight = np.ones(A.shape[1]), np.ones(len(b))
    for _ in range(5):
        H = (A * weight[:, None]).T @ A + near_one * np.eye(A.shape[1])
        level = np.linalg.solve(H, A.T @ (weight * b) + near_one)
        weight = 1 / (1 + (b - A @ level) ** 2)
    out = np.full((2, len(lights)), np.nan)
    out[0, bright], out[1, bright] = level, np.sqrt(np.diag(np.linalg.inv(H)))
    return out[0], out[1]

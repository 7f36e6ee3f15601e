"""The longitudinal lobe of a hair fibre (Sun Eq. 8) and the maps between its parameters.

Angles are inclinations towards the tip, in radians: 0 is perpendicular to the fibre, both
directions point away from it, and the untilted mirror direction is theta_o = -theta_i.
"""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import i0e

from reconstruction.arrays import Array

LEAST_VARIANCE = 1e-7
"""Smallest longitudinal variance; a lobe of 0.02 degrees."""
GREATEST_VARIANCE = 110.0
"""Largest longitudinal variance: the TRT lobe's 4v at beta_m = 1 is 109.8."""
LEAST_COLOUR = 1e-6
"""Multiple-scattering albedo below which a channel counts as black."""


class ColourRange(UserWarning):
    """A multiple-scattering albedo outside (0, 1] was clamped."""


def log_longitudinal(theta_i: ArrayLike, theta_o: ArrayLike, v: ArrayLike) -> Array:
    """Logarithm of the longitudinal lobe M (Sun 2021, Eq. 8), of the arguments' broadcast shape.

    M = I0(c/v) exp(-s/v - 1/v) / (v (1 - exp(-2/v))), c = cos cos, s = sin sin, normalised so that
    the integral of M cos(theta_o) over theta_o is 1. As printed it overflows below v = 0.0015 and
    cancels long before; here I0 is scaled by exp(-c/v), and c - s - 1 = -2 sin²((theta_i +
    theta_o)/2) is never formed by subtraction.

    `theta_i`, `theta_o` are inclinations in radians, `v` the variance in [1e-7, 110]. Raises
    `ValueError` for a variance outside.
    """
    v = _variance(v)
    theta_i, theta_o = np.asarray(theta_i, float), np.asarray(theta_o, float)
    c = np.maximum(np.cos(theta_i) * np.cos(theta_o), 0.0)
    exponent = -2.0 * np.sin(0.5 * (theta_i + theta_o)) ** 2 / v
    return np.asarray(np.log(i0e(c / v)) + exponent - np.log(-v * np.expm1(-2.0 / v)))


def longitudinal(theta_i: ArrayLike, theta_o: ArrayLike, v: ArrayLike) -> Array:
    """The lobe M of `log_longitudinal`, of their broadcast shape; 0 where it underflows."""
    return np.exp(log_longitudinal(theta_i, theta_o, v))


def variance_of_roughness(beta_m: ArrayLike) -> Array:
    """Longitudinal variance v of Chiang's perceptual roughness `beta_m` in (0, 1], of any shape.

    v = (0.726 b + 0.812 b² + 3.7 b²⁰)² (Chiang et al. 2015). Sun's beta_l is this v.
    """
    b = np.asarray(beta_m, float)
    if not ((b > 0) & (b <= 1)).all():
        raise ValueError(f"beta_m must be in (0, 1], got {b}")
    return np.asarray((0.726 * b + 0.812 * b**2 + 3.7 * b**20) ** 2)


def roughness_of_variance(v: ArrayLike) -> Array:
    """Chiang's `beta_m` whose longitudinal variance is `v`, of any shape: the map above inverted.

    Monotone, so Newton's method kept inside a bracket; exact to rounding. Variances above 27.4,
    that no roughness has, give 1. Raises `ValueError` for variances outside [1e-7, 110].
    """
    root = np.sqrt(np.minimum(_variance(v), float(variance_of_roughness(1.0))))
    low, high = np.zeros_like(root), np.ones_like(root)
    b = np.minimum(root / 0.726, 1.0)
    for _ in range(60):
        error = 0.726 * b + 0.812 * b**2 + 3.7 * b**20 - root
        low, high = np.where(error < 0, b, low), np.where(error >= 0, b, high)
        step = b - error / (0.726 + 1.624 * b + 74.0 * b**19)
        b = np.where((step > low) & (step < high), step, 0.5 * (low + high))
    return b


def absorption_of_colour(colour: ArrayLike, beta_n: float) -> Array:
    """Absorption sigma_a per fibre radius giving dense hair the albedo `colour (…, 3)` (Eq. 11).

    sigma = (log C / P(beta_n))², with Chiang's bracket: as printed, Sun's closes too early. Albedos
    above 1 would alias to those below (1.25 gives the sigma of 0.8): they are clamped to 1, those
    under 1e-6 to 1e-6, with a `ColourRange` warning.
    """
    c = np.asarray(colour, float)
    if not np.isfinite(c).all():
        raise ValueError(f"colour must be finite, got {c}")
    if ((c <= 0) | (c > 1)).any():
        warnings.warn(f"albedo {c} is clamped to (0, 1]", ColourRange, stacklevel=2)
    return np.asarray((np.log(np.clip(c, LEAST_COLOUR, 1.0)) / bracket(_checked(beta_n))) ** 2)


def colour_of_absorption(sigma_a: ArrayLike, beta_n: float) -> Array:
    """Multiple-scattering albedo of dense hair of absorption `sigma_a (…, 3)`: Eq. 11 inverted."""
    sigma = np.asarray(sigma_a, float)
    if not (sigma >= 0).all():
        raise ValueError(f"sigma_a must not be negative, got {sigma}")
    return np.exp(-np.sqrt(sigma) * bracket(_checked(beta_n)))


def _variance(v: ArrayLike) -> Array:
    v = np.asarray(v, float)
    # float32 callers arrive a rounding below the ends of the range
    inside = (v >= LEAST_VARIANCE * (1 - 1e-6)) & (v <= GREATEST_VARIANCE * (1 + 1e-6))
    if not inside.all():
        raise ValueError(f"v must be in [{LEAST_VARIANCE}, {GREATEST_VARIANCE}], got {v}")
    return v


def bracket(b: Any) -> Any:
    """Chiang's polynomial P of the azimuthal roughness `b` (2016, eq. 9), in any arithmetic."""
    return 5.969 - 0.215 * b + 2.532 * b**2 - 10.73 * b**3 + 5.574 * b**4 + 0.245 * b**5


def _checked(beta_n: float) -> float:
    if not 0 < beta_n <= 1:
        raise ValueError(f"beta_n must be in (0, 1], got {beta_n}")
    return beta_n

"""Signed distances to simple bodies and their rounded unions, metres, negative inside."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from reconstruction.arrays import Array


def ellipsoid(p: Array, center: ArrayLike, radii: ArrayLike, tilt_deg: float = 0.0) -> Array:
    """Approximate distance `(...)` of `p (..., 3)` to an ellipsoid turned by `tilt_deg` about x."""
    c, s = np.cos(np.radians(tilt_deg)), np.sin(np.radians(tilt_deg))
    q = p - np.asarray(center)
    q = np.stack([q[..., 0], c * q[..., 1] - s * q[..., 2], s * q[..., 1] + c * q[..., 2]], -1)
    r = np.asarray(radii)
    k0 = np.linalg.norm(q / r, axis=-1)
    k1 = np.linalg.norm(q / (r * r), axis=-1)
    return np.asarray(k0 * (k0 - 1) / np.maximum(k1, 1e-9))


def capsule(p: Array, a: ArrayLike, b: ArrayLike, r_a: float, r_b: float) -> Array:
    """Distance `(...)` of `p (..., 3)` to a rod from `a (3,)` to `b (3,)`.

    Its ends are round, its radius goes from `r_a` to `r_b`.
    """
    a, b = np.asarray(a, float), np.asarray(b, float)
    h = np.clip((p - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
    away = np.linalg.norm(p - a - h[..., None] * (b - a), axis=-1)
    return np.asarray(away - r_a - h * (r_b - r_a))


def blend(a: Array, b: Array, width: float) -> Array:
    """Union `(...)` whose seam is rounded over `width` metres (polynomial smooth minimum)."""
    h = np.clip(0.5 + 0.5 * (b - a) / width, 0, 1)
    return b + h * (a - b) - width * h * (1 - h)


def carve(a: Array, b: Array, width: float) -> Array:
    """`a (...)` without `b (...)`, the edge rounded over `width` metres."""
    return -blend(-a, b, width)

"""What a fit minimises: an image loss on hair pixels, and smoothness along strands.

Everything is a mean, in exposure units, so that weights mean the same at any resolution. The
papers' L1 fits the median of a path tracer's noise, which lies far below its mean. Squared
differences with independent noise are unbiased; weights make them differences of displayed (sRGB)
values. Their square root is minimised: as proportional to the difference as L1 is.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
from scipy.ndimage import correlate1d

from reconstruction.arrays import Array, Bools

FLOOR = 0.03
LEAST_NOISE = 0.1
"""Of the median pixel's: what a pixel's noise is held to be at least, known from few paths."""
LEAST_ERROR = 0.02
"""Of the root of the squares: below it smoothness gets no more say."""
LAMBDA_SIGMA, LAMBDA_R = 0.5, 0.003
"""Weights of smoothness along strands, of absorption, and of correctives: GroomLight's 10 forbids
turns that undo a bend of 5°. Between neighbours on the scalp too, where correctives are solved
for."""


def level(captured: Array) -> Array:
    """Mean of each captured pixel's neighbours in image order `(L, P, 3)`, to make weights of.

    Of the two on either side, without the pixel itself: a weight would be largest where noise made
    it dark, and a fit darker than the truth the better one.
    """
    values = np.maximum(captured, 0)
    return np.asarray(correlate1d(values, [0.25, 0.25, 0, 0.25, 0.25], axis=1, mode="mirror"))


def weights(level: Array) -> Array:
    """Weight of a squared difference at a captured `level`, of its shape, in exposure units.

    The squared slope of the sRGB curve, with a floor below which darkness counts no more.
    """
    return 0.2 * (level + FLOOR) ** -1.17


def noise_weighted(weight: Array, squares: Array) -> Array:
    """`weight (L, P, 3)`, less of it where pictures are noisy: one pixel in a hundred has two
    fifths of all noise.

    `squares` are those of differences of independent pictures. They are averaged over channels and
    five pixels in image order; a pixel of the median noise keeps half of its weight, all together
    keep theirs. The weights do not depend on what is judged, if the squares do not.
    """
    noise = correlate1d(squares.mean(axis=-1), np.full(5, 0.2), axis=1, mode="mirror")[..., None]
    relative = weight * noise
    counted = relative[weight > 0]
    usual = float(np.median(counted)) if counted.size else 0.0
    if not usual > 0:
        return weight
    out = weight / (1 + LEAST_NOISE + relative / usual)
    return np.asarray(out * (weight.sum() / out.sum()))


def gradient(difference: Array, level: Array, valid: Bools, error: float) -> Array:
    """Derivative of the image loss by the rendered values `(L, P, 3)`, in exposure units.

    `difference` is rendered less captured; `valid (L, P)`; `error` an estimate of the mean of
    the squares, of which the root is taken.
    """
    root = max(error, LEAST_ERROR**2) ** 0.5
    out = difference * weights(level) / root
    used = max(int(valid.sum()), 1) * 3
    return np.where(valid[..., None], out, 0.0) / used


def squares(one: Array, other: Array, weight: Array, valid: Bools) -> float:
    """Weighted mean square of the differences `one`, `other (L, P, 3)` of independent renderings.

    Without their noise: may be slightly negative where the renderings agree with the captured.
    """
    return float((one * other * weight)[valid].mean()) if valid.any() else 0.0


def smoothness(values: dict[str, Any]) -> Any:
    """λ_σ mean |σ_i − σ_(i−1)| + λ_R mean |R_i − R_(i−1)| over layers (GroomLight Eq. 4 and 5).

    Cells whose strands no ray meets follow their neighbours along the strand. A Dr.Jit number, or
    0 for a single layer.
    """
    total: Any = 0.0
    for name, weight in (("hair.sigma_a", LAMBDA_SIGMA), ("hair.rotation", LAMBDA_R)):
        table = values[name]
        if table.ndim == 4 and table.shape[0] > 1 and dr.grad_enabled(table):
            step = table[1:] - table[:-1]
            # rounded off at a thousandth: no jitter about equal layers
            total = total + weight * dr.mean(dr.sqrt(step * step + 1e-6), axis=None)
    return total

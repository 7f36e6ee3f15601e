"""What a fit minimises: an image loss on hair pixels, and smoothness along strands.

Everything is a mean: the image loss over pixels, lights and channels of one exposure (the training
hair's 99th percentile at 1), smoothness over neighbouring layers, cells and channels. So the
weights mean the same whatever the resolution of images and maps.

The papers' L1 takes the sign of a noisy difference: with few samples a pixel it fits the median of
the noise, which for path tracing lies far below its mean. "squares" is unbiased: squared
differences, the picture's and the gradient's noise independent of each other, with fixed weights
1/(captured + 0.1), under which a small error of a bright and of a dark pixel count as in L1.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
FLOOR = 0.1
LAMBDA_SIGMA, LAMBDA_R = 0.5, 10.0


def weights(captured: Array) -> Array:
    """Weight of each squared difference; `captured` in exposure units."""
    return 1.0 / (np.maximum(captured, 0) + FLOOR)


def slope(rendered: Array, captured: Array, valid: NDArray[np.bool_], kind: str) -> Array:
    """Derivative of the mean image loss by the rendered values `(L, P, 3)`, in exposure units.

    `valid (L, P)`. `kind` is "squares" or "l1".
    """
    difference = rendered - captured
    out = np.sign(difference) if kind == "l1" else difference * weights(captured)
    used = max(int(valid.sum()), 1) * 3
    return np.where(valid[..., None], out, 0.0) / used


def squares(one: Array, other: Array, captured: Array, valid: NDArray[np.bool_]) -> float:
    """Weighted mean squared difference without the noise of two independent renderings.

    May be slightly negative where both agree with the captured image to their noise.
    """
    product = (one - captured) * (other - captured) * weights(captured)
    return float(product[valid].mean()) if valid.any() else 0.0


def smoothness(values: dict[str, Any], lambda_sigma: float, lambda_r: float) -> Any:
    """λ_σ mean |σ_i − σ_(i−1)| + λ_R mean |R_i − R_(i−1)| over layers (GroomLight Eq. 4 and 5).

    Cells whose strands no ray meets follow their neighbours along the strand. A Dr.Jit number, or
    0 for a single layer.
    """
    import drjit as dr

    total: Any = 0.0
    for name, weight in (("hair.sigma_a", lambda_sigma), ("hair.rotation", lambda_r)):
        table = values[name]
        if weight > 0 and table.ndim == 4 and table.shape[0] > 1 and dr.grad_enabled(table):
            step = table[1:] - table[:-1]
            # rounded off at a thousandth: no jitter about equal layers
            total = total + weight * dr.mean(dr.sqrt(step * step + 1e-6), axis=None)
    return total

"""The image loss on hair pixels that a fit minimises.

Everything is a mean, in exposure units, so that weights mean the same at any resolution. The
papers' L1 fits the median of a path tracer's noise, which lies far below its mean. Squared
differences with independent noise are unbiased; weights make them differences of displayed (sRGB)
values. Their square root is minimised: as proportional to the difference as L1 is.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import correlate1d, uniform_filter1d

from reconstruction.arrays import Array

FLOOR = 0.03
LEAST_NOISE = 0.1
"""Least noise of a pixel, relative to the median: few paths estimate it poorly."""
_LEVELS, _FEWEST_ALIKE = 64, 5
"""Levels of light that noise is estimated at, and pixels of each at least."""
LEAST_ERROR = 0.02
"""Of the root of the squares: below it smoothness weighs no more."""
LAMBDA_R = 0.003
"""Weight of the differences of correctives between neighbours, along strands and on the scalp:
GroomLight's 10 forbids the turns that undo a bend of 5°."""


def level(captured: Array) -> Array:
    """Mean of the two neighbours on either side in image order `(L, P, 3)`, for weights.

    Without the pixel itself, whose noise would bias its weight and the fit.
    """
    values = np.maximum(captured, 0)
    return np.asarray(correlate1d(values, [0.25, 0.25, 0, 0.25, 0.25], axis=1, mode="mirror"))


def weights(level: Array) -> Array:
    """Weight of a squared difference at a captured `level`, of its shape, in exposure units.

    The squared derivative of the sRGB curve, bounded by a floor.
    """
    return 0.2 * (level + FLOOR) ** -1.17


def noise_weighted(weight: Array, squares: Array, light: Array) -> Array:
    """`weight (L, P, 3)`, reduced where noise is high: one pixel in a hundred has two fifths of it.

    `squares` are those of differences of independent renderings, `light` the mean of captured and
    rendered light. Noise is the mean of the squares over pixels of similar light: with each pixel's
    own noise, rendered highlights would weigh less than captured ones, and where strands are off,
    hair be fitted far too bright. A pixel of the median noise keeps half of its weight, and the sum
    is kept. All are of one shape; light is averaged over five pixels in image order.
    """
    near = correlate1d(light.mean(axis=-1), np.full(5, 0.2), axis=1, mode="mirror")
    order = np.argsort(near, axis=None)
    noise = np.empty(order.shape)
    size = max(_FEWEST_ALIKE, len(order) // _LEVELS)
    noise[order] = uniform_filter1d(squares.mean(axis=-1).ravel()[order], size, mode="nearest")
    relative = weight * noise.reshape(*weight.shape[:-1], 1)
    counted = relative[weight > 0]
    usual = float(np.median(counted)) if counted.size else 0.0
    if not usual > 0:
        return weight
    out = weight / (1 + LEAST_NOISE + relative / usual)
    return np.asarray(out * (weight.sum() / out.sum()))

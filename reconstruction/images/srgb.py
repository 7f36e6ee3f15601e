"""The sRGB curve."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from reconstruction.arrays import Array


def srgb(linear: ArrayLike) -> Array:
    """The sRGB curve (IEC 61966-2-1) on values of any shape, clipped to [0, 1]."""
    x = np.clip(np.asarray(linear, float), 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)

"""Light that a camera's dark frames hold: no lamp sent it, so it is no answer to one."""

from __future__ import annotations

import cv2
import numpy as np

from reconstruction.arrays import Floats

WINDOW = 5
"""Pixels a side of the means that tell stray light from noise."""


def stray_light(dark: Floats) -> Floats | None:
    """What of a `dark` frame `(H, W, 3)`, or a mean of some, is light; None where nothing is.

    It is light where its mean over `WINDOW` × `WINDOW` pixels is more than the noise of one pixel;
    elsewhere it is 0: less would bring its own noise into every frame that it is taken off.
    Raises `ValueError` for NaN.
    """
    if np.isnan(dark).any():
        raise ValueError("a dark frame has values that are not numbers")
    mean = cv2.blur(np.asarray(dark, np.float32), (WINDOW, WINDOW))
    low, high = np.percentile(dark - mean, (16, 84), axis=(0, 1))
    there = mean > 0.5 * (high - low)
    return np.where(there, dark, np.float32(0)) if there.any() else None

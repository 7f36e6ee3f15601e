"""Stray light in a camera's dark frames."""

from __future__ import annotations

import cv2
import numpy as np

from reconstruction.arrays import Floats

WINDOW = 5
"""Side in pixels of the means that separate stray light from noise."""


def stray_light(dark: Floats) -> Floats | None:
    """Stray light `(H, W, 3)` in a `dark` frame, or a mean of several; None without any.

    It is the frame where its mean over `WINDOW`² pixels exceeds the noise of one pixel, else 0:
    subtracting more would add noise to every frame. Raises `ValueError` for NaN.
    """
    if np.isnan(dark).any():
        raise ValueError("a dark frame has values that are not numbers")
    mean = cv2.blur(np.asarray(dark, np.float32), (WINDOW, WINDOW))
    low, high = np.percentile(dark - mean, (16, 84), axis=(0, 1))
    there = mean > 0.5 * (high - low)
    return np.where(there, dark, np.float32(0)) if there.any() else None

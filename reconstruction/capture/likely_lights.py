"""A guess of the lights' intensity for images in relative units, from a head's reflectance."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from reconstruction.arrays import Floats
from reconstruction.geometry.lights import Lighting

LIKELY = 0.2
"""Assumed reflectance of a head; measured for brown hair and fair skin: 0.18."""
_BRIGHTEST = 98.0  # percentile of lit pixels at which highlights and noise are clipped


def likely_strength(shown: Iterable[tuple[Lighting, Floats]]) -> float:
    """Factor on the lights' intensities; 1 if all images are dark.

    `shown` are lights or patterns, and images `(H, W, 3)` under each, in any unit. The reflectance
    of an image is its radiance over that of a white matte surface at the origin facing the light,
    averaged with itself as weight, so that a dark background does not count. The median over images
    is used, since lights behind and in front of the head differ.
    """
    found = []
    for light, image in shown:
        grey = np.maximum(image.mean(axis=-1, dtype=float), 0)
        white = float(light.irradiance(np.zeros(3)).mean()) / np.pi
        if white > 0 and grey.any():
            grey = np.minimum(grey, np.percentile(grey[grey > 0.02 * grey.max()], _BRIGHTEST))
            found.append((grey**2).sum() / grey.sum() / white)
    return float(np.median(found)) / LIKELY if found else 1.0

"""How strong the lights are of pictures in relative units: as hair and skin make likely, a guess.

Where nothing says what a picture's numbers are in W/(sr m²), any strength of the lights is as true
as another; but what is fitted to the pictures takes hair to reflect some of its light and no more.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from reconstruction.arrays import Floats
from reconstruction.geometry.lights import Light

LIKELY = 0.2
"""Of its light that a head is taken to reflect, as measured here: brown hair and fair skin 0.18."""
_BRIGHTEST = 98.0  # percentile of what is not dark from which on a pixel is a highlight, or noise


def likely_strength(shown: Iterable[tuple[Light, Floats]]) -> float:
    """What the lights' intensities are to be multiplied by; 1 where all pictures are dark.

    `shown` are lights and what pictures `(H, W, 3)` show under each alone, in any unit. What a
    picture reflects is its radiance over that of a white matte surface at the origin that faces the
    light, averaged with itself as weight: a dark background, however large, has no say. Of the
    pictures the median counts, so that neither lights behind the head decide nor those before it.
    """
    found = []
    for light, image in shown:
        grey = np.maximum(image.mean(axis=-1, dtype=float), 0)
        squared = float(light.position @ light.position)
        white = float(light.intensity_towards(np.zeros(3)).mean()) / max(squared, 1e-12) / np.pi
        if white > 0 and grey.any():
            grey = np.minimum(grey, np.percentile(grey[grey > 0.02 * grey.max()], _BRIGHTEST))
            found.append((grey**2).sum() / grey.sum() / white)
    return float(np.median(found)) / LIKELY if found else 1.0

"""Raw images by the names of their GenICam pixel formats: MonoN and BayerXYN, N bits unpacked."""

from __future__ import annotations

import re

import cv2
import numpy as np
from numpy.typing import NDArray

DEMOSAIC = {
    "RG": cv2.COLOR_BayerRGGB2RGB,
    "GR": cv2.COLOR_BayerGRBG2RGB,
    "GB": cv2.COLOR_BayerGBRG2RGB,
    "BG": cv2.COLOR_BayerBGGR2RGB,
}
"""Bilinear, so linear in the counts: frames of single lights add up to that of all lights."""


def full_scale(pixel_format: str) -> int:
    """The greatest count."""
    return (1 << int(re.sub(r"\D", "", pixel_format))) - 1


def rgb(raw: NDArray[np.unsignedinteger], pixel_format: str) -> NDArray[np.uint16]:
    """Counts `(H, W, 3)` of the raw image `(H, W)`; mono in all three channels."""
    if pixel_format.startswith("Mono"):
        return np.repeat(raw[..., None], 3, axis=2).astype(np.uint16)
    return cv2.cvtColor(raw, DEMOSAIC[pixel_format[5:7]]).astype(np.uint16)

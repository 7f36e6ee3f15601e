"""Frames as pictures for people."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from appearance.metrics.scores import srgb
from reconstruction import read_exr


def png_preview(path: Path, percentile: float = 99.5) -> bytes:
    """A PNG of an EXR file: exposed so that `percentile` of its values reach white, sRGB curve.

    Clipped and 8 bits a channel: to look at, never to measure.
    """
    image, _ = read_exr(path)
    white = float(np.percentile(image, percentile))
    picture = np.rint(255 * srgb(image / white if white > 0 else image))
    done, png = cv2.imencode(".png", picture[..., ::-1].astype(np.uint8))
    if not done:
        raise ValueError(f"{path}: OpenCV cannot encode a PNG of shape {image.shape}")
    return png.tobytes()

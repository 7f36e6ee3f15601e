"""Frames as pictures for people."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from reconstruction.exr import read_exr


def png_preview(path: Path, percentile: float = 99.5) -> bytes:
    """A PNG of an EXR file: exposed so that `percentile` of its values reach white, sRGB curve.

    Clipped and 8 bits a channel: to look at, never to measure.
    """
    image, _ = read_exr(path)
    white = float(np.percentile(image, percentile))
    scaled = np.clip(image / white if white > 0 else image, 0.0, 1.0)
    curved = np.where(scaled <= 0.0031308, 12.92 * scaled, 1.055 * scaled ** (1 / 2.4) - 0.055)
    done, png = cv2.imencode(".png", np.rint(255 * curved[..., ::-1]).astype(np.uint8))
    if not done:
        raise ValueError(f"{path}: OpenCV cannot encode a PNG of shape {image.shape}")
    return png.tobytes()

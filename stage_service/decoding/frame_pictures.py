"""Previews and exposure figures of frames."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np

from reconstruction.arrays import Bools, Floats
from reconstruction.images.srgb import srgb

MARK = (1.0, 0.0, 1.0)
"""Colour of saturated pixels."""
BINS = 64
_ROWS = 256
"""Rows converted at a time, to save memory."""
Attributes = Mapping[str, float | str]


def png_of_frame(
    image: Floats,
    attributes: Attributes,
    *,
    percentile: float = 99.5,
    white: float | None = None,
    size: int | None = None,
    mark: bool = False,
) -> bytes:
    """A PNG preview of a frame `(H, W, 3)`: `percentile` of its values, or `white`, becomes white;
    sRGB, at most `size` pixels on the longer side. `mark` marks saturated pixels.

    Overwrites the image.
    """
    full = _saturated(image, attributes) if mark else None
    longest, shown = max(image.shape[:2]), image
    if size is not None and size < longest:
        height, width = (max(1, round(n * size / longest)) for n in image.shape[:2])
        shown = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        if full is not None:
            shares = full.astype(np.float32)
            full = cv2.resize(shares, (width, height), interpolation=cv2.INTER_AREA) > 0
    if white is None:
        # in place if the image is not needed any more
        white = float(np.percentile(image, percentile, overwrite_input=shown is not image))
    out = np.empty(shown.shape, np.uint8)
    for first in range(0, len(shown), _ROWS):
        rows = slice(first, first + _ROWS)
        part = srgb(shown[rows] / white if white > 0 else shown[rows])
        if full is not None:
            part[full[rows]] = MARK
        out[rows] = np.rint(255 * part)[..., ::-1]
    done, png = cv2.imencode(".png", out)
    if not done:
        raise ValueError(f"OpenCV cannot encode a PNG of shape {out.shape}")
    return png.tobytes()


def frame_figures(image: Floats, attributes: Attributes) -> dict[str, Any]:
    """Exposure and sharpness of a frame `(H, W, 3)`: the fields of `FrameFigures`."""
    full_scale = attributes.get("fullScale")
    largest = float(image.max())
    top = float(full_scale) if full_scale is not None else largest
    counts, _ = np.histogram(image, bins=BINS, range=(0.0, top if top > 0 else 1.0))
    green = np.asarray(image[..., 1], np.float64)
    mean = float(green.mean())
    return {
        "width": image.shape[1],
        "height": image.shape[0],
        "largest": largest,
        "white": float(np.percentile(image, 99.5)),
        "full_scale": None if full_scale is None else float(full_scale),
        "saturated": float(_saturated(image, attributes).mean()),
        "histogram": [int(n) for n in counts],
        "focus": float(cv2.Laplacian(green, cv2.CV_64F).var()) / mean**2 if mean > 0 else 0.0,
    }


def _saturated(image: Floats, attributes: Attributes) -> Bools:
    """Pixels `(H, W)` with a channel at full scale."""
    full_scale = float(attributes.get("fullScale", np.inf))
    return np.asarray((image >= full_scale * (1 - 1e-5)).any(axis=-1))

"""Frames as pictures for people."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from pydantic import BaseModel

from appearance.metrics.scores import srgb
from reconstruction import read_exr
from reconstruction.arrays import Bools, Floats

MARK = (1.0, 0.0, 1.0)
"""A colour that hair does not have."""
BINS = 64


class FrameFigures(BaseModel):
    """How a frame is exposed. `white`: the 99.5 % quantile of its values, W/(sr m²); `saturated`:
    the share of its pixels of which a channel is at `full_scale` (None: it never saturates).

    `histogram` counts values in 64 equal bins from 0 to full scale, or to the largest value.
    `focus` is the variance of the green channel's Laplacian by the square of its mean: it is at its
    largest where the picture is sharpest, and compares frames of one camera in one light.
    """

    width: int
    height: int
    largest: float
    white: float
    full_scale: float | None
    saturated: float
    histogram: list[int]
    focus: float


def png_preview(
    path: Path,
    *,
    percentile: float = 99.5,
    white: float | None = None,
    size: int | None = None,
    mark: bool = False,
) -> bytes:
    """A PNG of an EXR file: exposed so that `percentile` of its values, or `white`, reach white;
    sRGB curve, at most `size` pixels on its longer side. `mark` paints what is saturated.

    Clipped and 8 bits a channel: to look at, never to measure.
    """
    image, attributes = read_exr(path)
    full = _saturated(image, attributes)
    top = float(np.percentile(image, percentile)) if white is None else white
    longest = max(image.shape[:2])
    if size is not None and size < longest:
        height, width = (max(1, round(n * size / longest)) for n in image.shape[:2])
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        shares = cv2.resize(full.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
        full = shares > 0
    shown = srgb(image / top if top > 0 else image)
    if mark:
        shown[full] = MARK
    done, png = cv2.imencode(".png", np.rint(255 * shown)[..., ::-1].astype(np.uint8))
    if not done:
        raise ValueError(f"{path}: OpenCV cannot encode a PNG of shape {image.shape}")
    return png.tobytes()


def figures_of(path: Path) -> FrameFigures:
    """How the frame in an EXR file is exposed."""
    image, attributes = read_exr(path)
    full_scale = attributes.get("fullScale")
    largest = float(image.max())
    top = float(full_scale) if full_scale is not None else largest
    counts, _ = np.histogram(image, bins=BINS, range=(0.0, top if top > 0 else 1.0))
    green = np.asarray(image[..., 1], np.float64)
    mean = float(green.mean())
    return FrameFigures(
        width=image.shape[1],
        height=image.shape[0],
        largest=largest,
        white=float(np.percentile(image, 99.5)),
        full_scale=None if full_scale is None else float(full_scale),
        saturated=float(_saturated(image, attributes).mean()),
        histogram=[int(n) for n in counts],
        focus=float(cv2.Laplacian(green, cv2.CV_64F).var()) / mean**2 if mean > 0 else 0.0,
    )


def _saturated(image: Floats, attributes: dict[str, float | str]) -> Bools:
    """Pixels `(H, W)` of which a channel is at full scale."""
    full_scale = float(attributes.get("fullScale", np.inf))
    return np.asarray((image >= full_scale * (1 - 1e-5)).any(axis=-1))

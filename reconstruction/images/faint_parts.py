"""Parts of the subject that are lost in the noise of single pixels: hair that is dark or unlit."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy import ndimage

from reconstruction.arrays import AnyFloats, Bools, Floats
from reconstruction.capture.folder import Capture
from reconstruction.images.silhouettes import (
    FAINTEST,
    NOISE_FACTOR,
    NoSilhouette,
    background,
    background_noise,
    edges,
    lit_image,
    silhouette,
)

MOST_CAMERAS = 4
SMOOTHED = 4.0
"""Pixels, of a Gaussian: noise falls to a fourteenth; strands still fill it."""
LARGEST_SHARE = 0.05
"""Of the lit area that may be missing from a mask without a warning: soft outlines."""


def faint_share(image: AnyFloats, mask: Bools) -> float:
    """Share of the lit area of a dark-subtracted `image (H, W)` that `mask (H, W)` lacks.

    Lit is what a Gaussian mean over `SMOOTHED` pixels raises above `NOISE_FACTOR` deviations of
    its own noise, and not above those of a pixel. 0 without noise, or if it covers half of the
    image's edges, as a wall does.
    """
    level, noise = background(image)
    if not mask.any() or not noise > 0:
        return 0.0
    away = ~ndimage.binary_dilation(mask, iterations=3)  # bright outlines are not smoothed in
    if not away.any():
        return 0.0
    weight = ndimage.gaussian_filter(away.astype(np.float32), SMOOTHED)
    values: Floats = np.where(away, image - level, 0).astype(np.float32)
    mean = ndimage.gaussian_filter(values, SMOOTHED) / np.maximum(weight, 1e-6)
    least = NOISE_FACTOR * background_noise(mean[away])
    least = max(least, FAINTEST * (float(np.percentile(image[mask], 95)) - level))
    faint = away & (weight > 0.1) & (mean > least) & (mean < NOISE_FACTOR * noise)
    faint = ndimage.binary_opening(faint, iterations=int(SMOOTHED))
    if 2 * int(faint[edges(faint)].sum()) > int(edges(faint).sum()):
        return 0.0
    return float(faint.sum() / (faint.sum() + mask.sum()))


def faint_warnings(capture: Capture, subjects: Mapping[str, Bools] | None = None) -> list[str]:
    """A sentence on the cameras whose automatic silhouettes lack faint parts; none if none do.

    `subjects` are silhouettes that are known. Of the cameras without a user's mask,
    `MOST_CAMERAS` are checked.
    """
    names = [c.name for c in capture.rig.cameras]
    names = [n for n in names if capture.mask(n) is None and capture.subject(n) is None]
    shares = {}
    for camera in names[:: max(1, len(names) // MOST_CAMERAS)][:MOST_CAMERAS]:
        try:
            known = (subjects or {}).get(camera)
            mask = silhouette(capture, camera) if known is None else known
            shares[camera] = faint_share(lit_image(capture, camera), mask)
        except NoSilhouette:
            continue
    found = ", ".join(f"{n} {s:.0%}" for n, s in shares.items() if s > LARGEST_SHARE)
    if not found:
        return []
    return [
        "dark hair or other parts of the subject are missing from the masks, since they are below "
        f"the noise of a pixel ({NOISE_FACTOR:g} standard deviations); about this share of the "
        f"lit area: {found}; expose longer, use more light, or provide hair masks "
        "(masks/CAMERA.png)"
    ]

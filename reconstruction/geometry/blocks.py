"""Images and masks reduced by whole factors; `Camera.reduced` is the camera of the result.

Rows and columns at the end that fill no block are cut off.
"""

from __future__ import annotations

import cv2
import numpy as np

from reconstruction.arrays import AnyFloats, Bools, Floats


def block_means(image: AnyFloats | Bools, by: int) -> Floats:
    """The means `(H // by, W // by, ...)` over blocks of `image (H, W, ...)`."""
    if by == 1:
        return np.asarray(image, np.float32)
    height, width = (n // by for n in image.shape[:2])
    whole = np.ascontiguousarray(image[: height * by, : width * by], np.float32)
    out = cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA)
    return out.reshape(height, width, *image.shape[2:])


def block_any(mask: Bools, by: int) -> Bools:
    """Blocks `(H // by, W // by)` that hold a marked pixel of `mask (H, W)`."""
    height, width = (n // by for n in mask.shape)
    blocks = mask[: height * by, : width * by].reshape(height, by, width, by)
    return np.asarray(blocks.any(axis=(1, 3)))


def unblocked(mask: Bools, by: int, height: int, width: int) -> Bools:
    """A `mask` of blocks at full resolution `(height, width)`; the last block is repeated."""
    rows = np.minimum(np.arange(height) // by, mask.shape[0] - 1)
    columns = np.minimum(np.arange(width) // by, mask.shape[1] - 1)
    return np.asarray(mask[np.ix_(rows, columns)])

"""Images and masks with a lens's distortion and without."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike

from reconstruction.arrays import Array, Bools, Floats
from reconstruction.geometry.cameras import Camera

Maps = tuple[Floats, Floats]


@dataclass(frozen=True, eq=False)
class Lens:
    """One camera `as_shot` and the pinhole `undistorted` that its images are resampled to.

    `to_shot` are the coordinates (x, y), each `(H, W)`, of undistorted pixels in the image as shot;
    `to_undistorted` those of shot pixels in the undistorted image.
    """

    as_shot: Camera
    undistorted: Camera
    to_shot: Maps
    to_undistorted: Maps

    @classmethod
    def of(cls, bent: Camera) -> Lens:
        """The lens of the camera `bent`, as shot.

        The undistorted image is the largest upright one without pixels outside the shot one, at
        the scale of the shot image's centre.
        """
        pinhole = bent.pinhole()
        x, y = np.arange(bent.width), np.arange(bent.height)
        x0 = int(np.ceil(_moved(bent, pinhole, 0, y)[0].max()))
        x1 = int(np.floor(_moved(bent, pinhole, bent.width - 1, y)[0].min()))
        y0 = int(np.ceil(_moved(bent, pinhole, x, 0)[1].max()))
        y1 = int(np.floor(_moved(bent, pinhole, x, bent.height - 1)[1].min()))
        K = bent.K.copy()
        K[:2, 2] -= x0, y0
        straight = replace(pinhole, K=K, width=x1 - x0 + 1, height=y1 - y0 + 1)
        return cls(bent, straight, _grid(straight, bent), _grid(bent, straight))

    def undistort(self, image: Floats) -> Floats:
        """An image `(H, W, C)` as shot, undistorted: `resampled`."""
        return resampled(image, self.to_shot)

    def undistort_mask(self, mask: Bools) -> Bools:
        """A mask `(H, W)` in the pixels as shot, in the undistorted ones."""
        return np.asarray(_weight(mask, self.to_shot) >= 0.5)

    def undistort_any(self, mask: Bools) -> Bools:
        """Undistorted pixels `(H, W)` that any marked pixel of the shot `mask` goes into."""
        return any_resampled(mask, self.to_shot)

    def distort_mask(self, mask: Bools) -> Bools:
        """The inverse of `undistort_mask`: a mask `(H, W)` as the lens shows it."""
        return np.asarray(_weight(mask, self.to_undistorted) >= 0.5)

    def kept(self) -> float:
        """The share of the shot image's pixels inside the undistorted one."""
        pixels = np.stack(self.to_undistorted, axis=-1)
        return float(self.undistorted.inside(pixels).mean())


def resampled(image: Floats, maps: Maps) -> Floats:
    """An image `(H, W, C)` at the coordinates `maps`, by cubic interpolation.

    Negative values are clamped to the least of the four pixels around: a cubic's undershoot at an
    edge would count as noise.
    """
    x, y = maps
    image = np.ascontiguousarray(image, dtype=np.float32)
    out = cv2.remap(image, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    least = cv2.erode(image, np.ones((2, 2), np.uint8), anchor=(1, 1))  # of these and before
    least = cv2.remap(least, np.ceil(x), np.ceil(y), cv2.INTER_NEAREST)
    return np.maximum(out, np.minimum(least, 0)).reshape(*x.shape, -1)


def any_resampled(mask: Bools, maps: Maps) -> Bools:
    """Pixels at the coordinates `maps` that any marked pixel of `mask (H, W)` goes into."""
    return np.asarray(_weight(mask, maps) > 0)


def _moved(source: Camera, target: Camera, x: ArrayLike, y: ArrayLike) -> tuple[Array, Array]:
    """Pixels of `source` in the image of `target`, which has the same centre."""
    pixels = np.stack(np.broadcast_arrays(x, y), axis=-1)
    moved, _ = target.project(target.center + source.rays(pixels))
    return moved[..., 0], moved[..., 1]


def _grid(source: Camera, target: Camera) -> Maps:
    x, y = np.meshgrid(np.arange(source.width), np.arange(source.height))
    u, v = _moved(source, target, x, y)
    return u.astype(np.float32), v.astype(np.float32)


def _weight(mask: Bools, maps: Maps) -> Floats:
    return cv2.remap(mask.astype(np.float32), *maps, cv2.INTER_LINEAR)

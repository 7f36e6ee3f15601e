"""Sub-pixel rigid registration of two images of one camera (Photobooth Eq. 1)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from reconstruction.arrays import AnyFloats, Array, Bools

BLUR = 1.0  # pixels of the Gaussian against aliasing


@dataclass(frozen=True, eq=False)
class Registration:
    """A 2D rigid motion: pixel `p` of the reference is at `c + R(angle) (p - c) + shift`.

    `centre (2,)` and `shift (2,)` in pixels, `angle` in radians from +x towards +y. `deviation
    (3,)` of the shift's x and y (pixels) and of the angle, from the residual; `lever` (pixels) is
    the rms distance of the used pixels from the centre, which turns angles into pixels.
    """

    centre: Array
    shift: Array
    angle: float
    deviation: Array
    lever: float
    converged: bool

    def largest(self) -> float:
        """The larger of shift and rotation at the lever, pixels."""
        return max(float(np.linalg.norm(self.shift)), abs(self.angle) * self.lever)


class Template:
    """A reference image `(H, W)`, prepared for registration of others over `mask (H, W)`.

    Raises `ValueError` for an empty mask or an image without detail.
    """

    def __init__(self, image: AnyFloats, mask: Bools) -> None:
        if image.shape != mask.shape or image.ndim != 2:
            raise ValueError(f"image {image.shape} and mask {mask.shape} must be the same (H, W)")
        if not mask.any():
            raise ValueError("the registration mask is empty")
        self.mask = mask
        self.raw = np.asarray(image, np.float64)
        self.image = smooth(image, BLUR)
        self.y, self.x = (v.astype(np.float64) for v in np.nonzero(mask))
        self.centre = np.array([self.x.mean(), self.y.mean()])
        dx, dy = self.x - self.centre[0], self.y - self.centre[1]
        self.lever = float(max(np.sqrt(np.mean(dx**2 + dy**2)), 1.0))
        gx, gy = (g[mask] for g in gradients(self.image))
        self.values = self.image[mask]
        # the last column is the image's gain
        self.jacobian = np.stack([gx, gy, gy * dx - gx * dy, self.values], axis=1)
        scale = np.linalg.norm(self.jacobian, axis=0)
        normal = self.jacobian.T @ self.jacobian
        if scale.min() <= 0 or np.linalg.cond(normal / np.outer(scale, scale)) > 1e8:
            raise ValueError("the image has no detail inside the mask")
        self.inverse = np.linalg.inv(normal / np.outer(scale, scale)) / np.outer(scale, scale)

    def register(self, image: AnyFloats, *, iterations: int = 30) -> Registration:
        """Register `image (H, W)` by inverse compositional Gauss-Newton (Baker and Matthews 2004),
        until steps are under 0.001 pixel."""
        other = spline(smooth(image, BLUR))
        shift, angle, gain, converged = np.zeros(2), 0.0, 1.0, False
        error = np.zeros_like(self.values)
        dx, dy = self.x - self.centre[0], self.y - self.centre[1]
        for _ in range(iterations):
            c, s = np.cos(angle), np.sin(angle)
            u = self.centre[0] + c * dx - s * dy + shift[0]
            v = self.centre[1] + s * dx + c * dy + shift[1]
            error = sample(other, u, v) / gain - self.values
            step = self.inverse @ (self.jacobian.T @ error)
            gain *= 1 + float(np.clip(step[3], -0.5, 0.5))
            # compose with the inverse of the step that moves the reference onto the warped image
            step = -step
            angle += step[2]
            c, s = np.cos(angle), np.sin(angle)
            shift = shift + np.array([c * step[0] - s * step[1], s * step[0] + c * step[1]])
            if max(np.abs(step[:2]).max(), abs(step[2]) * self.lever) < 1e-3:
                converged = True
                break
        # smoothing correlates neighbours: one in 4 pi sigma² residuals is independent
        correlated = max(1.0, 4 * np.pi * BLUR**2)
        variance = float(error @ error) / max(len(error) - 4, 1) * correlated
        deviation = np.sqrt(np.maximum(np.diag(self.inverse)[:3] * variance, 0))
        return Registration(
            self.centre.copy(), shift, float(angle), deviation, self.lever, converged
        )


def smooth(image: AnyFloats, sigma: float) -> Array:
    """`image (H, W)` under a Gaussian of `sigma` pixels, edges repeated."""
    source = np.ascontiguousarray(image, dtype=np.float64)
    return np.asarray(cv2.GaussianBlur(source, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE))


def gradients(image: Array) -> tuple[Array, Array]:
    """Derivatives by x and y `(H, W)`, fourth-order central differences."""
    kernel = np.array([1, -8, 0, 8, -1]) / 12.0
    gx = cv2.filter2D(image, cv2.CV_64F, kernel[None], borderType=cv2.BORDER_REPLICATE)
    gy = cv2.filter2D(image, cv2.CV_64F, kernel[:, None], borderType=cv2.BORDER_REPLICATE)
    return np.asarray(gx), np.asarray(gy)


def spline(image: Array) -> Array:
    """Coefficients `(H, W)` of the cubic spline through `image`, for `sample`.

    OpenCV rounds positions to 1/32 pixel, which biases a registration by a twentieth of a pixel.
    """
    return np.asarray(ndimage.spline_filter(image, order=3, mode="nearest"))


def sample(coefficients: Array, x: Array, y: Array) -> Array:
    """A `spline` at the pixels `x (N,)`, `y (N,)`; beyond the edges the nearest edge's value."""
    return np.asarray(
        ndimage.map_coordinates(
            coefficients, np.stack([y, x]), order=3, mode="nearest", prefilter=False
        )
    )

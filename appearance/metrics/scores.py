"""Scores of rendered against captured images, on the hair.

PSNR, SSIM and, if the user supplies its weights, LPIPS compare images displayed with one exposure
for the capture (`Exposure`) and the sRGB curve; the relative error compares radiance.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import correlate1d

from appearance.metrics import lpips
from reconstruction.arrays import AnyFloats, Array, Bools
from reconstruction.images.srgb import srgb as srgb

_WINDOW = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
_WINDOW /= _WINDOW.sum()


@dataclass(frozen=True)
class Exposure:
    """One exposure for a capture: `scale` is the display value of 1 W/(sr m²)."""

    scale: float

    def __post_init__(self) -> None:
        if not (np.isfinite(self.scale) and self.scale > 0):
            raise ValueError(f"an exposure's scale must be positive, got {self.scale}")

    @classmethod
    def of(cls, hair_pixels: Iterable[ArrayLike]) -> Exposure:
        """The exposure that takes the 99th percentile of all `hair_pixels (P, 3)` to 1."""
        values = np.concatenate([np.asarray(p, float).ravel() for p in hair_pixels])
        if len(values) == 0 or not np.percentile(values, 99) > 0:
            raise ValueError("no training hair pixel is lit: the exposure cannot be set")
        return cls(1.0 / float(np.percentile(values, 99)))

    @classmethod
    def of_picture(cls, radiance: AnyFloats) -> Exposure:
        """The exposure by the lit pixels of `radiance (…, 3)` alone; 1 where there are none."""
        lit = radiance[radiance.sum(axis=-1) > 0]
        return cls.of([lit]) if len(lit) else cls(1.0)

    def __call__(self, radiance: ArrayLike) -> Array:
        """Image values in [0, 1] of `radiance`, any shape."""
        return srgb(np.asarray(radiance, float) * self.scale)


def scores(image: AnyFloats, truth: AnyFloats, mask: Bools | None = None) -> dict[str, float]:
    """ "psnr" and "ssim" of images `(H, W, 3)`, and "lpips" where its weights are given."""
    image, truth, mask = _checked(image, truth, mask)
    out = {"psnr": psnr(image, truth, mask), "ssim": ssim(image, truth, mask)}
    distance = lpips.lpips(image, truth, mask)
    return out if distance is None else {**out, "lpips": distance}


def mean_scores(images: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The mean over images of each score; there must be an image."""
    return {name: float(np.mean([one[name] for one in images])) for name in images[0]}


def scores_unavailable() -> dict[str, str]:
    """Names of scores that cannot be had here, with the reason."""
    return {} if os.environ.get(lpips.VARIABLE) else {"lpips": lpips.UNAVAILABLE}


def psnr(image: AnyFloats, truth: AnyFloats, mask: Bools | None = None) -> float:
    """Peak signal-to-noise ratio in dB for range 1, over the pixels of `mask (H, W)`.

    Both images are `(H, W, 3)` image values. Equal images give 100 dB, a number JSON can hold.
    """
    image, truth, mask = _checked(image, truth, mask)
    error = float(np.mean((image[mask] - truth[mask]) ** 2))
    return float(-10.0 * np.log10(max(error, 1e-10)))


def ssim(image: AnyFloats, truth: AnyFloats, mask: Bools | None = None) -> float:
    """Structural similarity: the mean of `ssim_map` over the pixels of `mask (H, W)`."""
    image, truth, mask = _checked(image, truth, mask)
    return float(ssim_map(image, truth, mask)[mask].mean())


def ssim_map(image: AnyFloats, truth: AnyFloats, mask: Bools | None = None) -> Array:
    """Structural similarity `(H, W, C)` (Wang 2004): 11×11 Gaussian of σ 1.5, range 1.

    A window's statistics are over its pixels in the mask, with weights rescaled to sum to 1, so
    that the background has no effect. 0 outside the mask.
    """
    image, truth, mask = _checked(image, truth, mask)
    weight = _blur(mask.astype(float))
    out = np.zeros(image.shape)
    for k in range(image.shape[2]):
        x, y = image[..., k], truth[..., k]
        mx, my, xx, yy, xy = (
            _blur(np.where(mask, z, 0.0))[mask] / weight[mask] for z in (x, y, x * x, y * y, x * y)
        )
        c1, c2 = 0.01**2, 0.03**2
        like = (2 * mx * my + c1) * (2 * (xy - mx * my) + c2)
        out[mask, k] = like / ((mx * mx + my * my + c1) * (xx - mx * mx + yy - my * my + c2))
    return out


def relative_error(radiance: AnyFloats, truth: AnyFloats, mask: Bools | None = None) -> float:
    """Root of the summed squared radiance error over that of the truth, on `mask (H, W)`."""
    radiance, truth, mask = _checked(radiance, truth, mask)
    scale = float(np.sum(truth[mask] ** 2))
    if not scale > 0:
        raise ValueError("the true image is black on the mask: a relative error has no meaning")
    return float(np.sqrt(np.sum((radiance[mask] - truth[mask]) ** 2) / scale))


def _blur(x: Array) -> Array:
    rows = correlate1d(x, _WINDOW, axis=0, mode="constant")
    return np.asarray(correlate1d(rows, _WINDOW, axis=1, mode="constant"))


def _checked(
    rendered: AnyFloats, captured: AnyFloats, mask: Bools | None
) -> tuple[Array, Array, Bools]:
    image, truth = np.asarray(rendered, np.float64), np.asarray(captured, np.float64)
    if image.shape != truth.shape or image.ndim != 3:
        raise ValueError(f"images must be alike (H, W, C), got {image.shape} and {truth.shape}")
    mask = np.ones(image.shape[:2], bool) if mask is None else np.asarray(mask, bool)
    if mask.shape != image.shape[:2] or not mask.any():
        raise ValueError(
            f"the mask must mark pixels of {image.shape[:2]}, got {mask.shape} with {mask.sum()}"
        )
    return image, truth, mask

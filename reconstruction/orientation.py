"""2D orientations of hair in images by a bank of log-Gabor filters (Sun §4.1, Photobooth §3.2)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

Images = NDArray[np.floating]
Bools = NDArray[np.bool_]

_FAINTEST = 1e-5
"""Relative detail that is rounding in single precision and not texture."""


@dataclass(frozen=True)
class LogGaborBank:
    """A bank of log-Gabor filters: exp(−log²(ρλ)/(2σ_λ²)) · exp(−Δ²/(2σ_φ²)).

    Sun Eq. 13 with the square that its print lost; ρ is the frequency in cycles per pixel, Δ the
    angle to the filter's own. `wavelength` λ in pixels, `bandwidth` σ_λ (natural logarithm),
    `count` filters over half a turn, `spread` σ_φ in units of 180°/count. The filters are
    one-sided in frequency, so that the magnitude of an answer does not depend on whether the
    pixel lies on a line or between two.
    """

    wavelength: float = 3.0
    bandwidth: float = float(np.log(2))
    count: int = 128
    spread: float = 2.0

    def __post_init__(self) -> None:
        if self.wavelength < 2 or self.bandwidth <= 0 or self.count < 4 or self.spread <= 0:
            raise ValueError(
                "a log-Gabor bank needs wavelength >= 2 pixels, bandwidth > 0, count >= 4 and "
                f"spread > 0, got {self}"
            )

    def filters(self, height: int, width: int) -> Iterator[NDArray[np.float32]]:
        """The `count` transfer functions `(height, width)`, in the layout of `fft2`.

        Filter k answers to lines at k · 180°/count from +x towards +y: its own frequencies are
        perpendicular to the lines.
        """
        fy = np.fft.fftfreq(height)[:, None]
        fx = np.fft.fftfreq(width)[None, :]
        rho = np.hypot(fx, fy)
        rho[0, 0] = 1.0
        radial = np.exp(-(np.log(rho * self.wavelength) ** 2) / (2 * self.bandwidth**2))
        radial[0, 0] = 0.0
        angle = np.arctan2(fy, fx)
        sigma = self.spread * np.pi / self.count
        for k in range(self.count):
            own = k * np.pi / self.count + np.pi / 2
            delta = (angle - own + np.pi) % (2 * np.pi) - np.pi
            yield np.asarray(radial * np.exp(-(delta**2) / (2 * sigma**2)), np.float32)

    def responses(self, images: Images) -> NDArray[np.float32]:
        """Magnitudes `(count, H, W)` of the answers to an image `(H, W)`, mirrored at its edges.

        Of a stack `(N, H, W)`, the sum of the magnitudes: one pass over the filters serves all.
        """
        images = np.asarray(images, np.float32)
        stack = images[None] if images.ndim == 2 else images
        shape = stack.shape[1:]
        margin = int(
            min(4 * self.wavelength * max(1.0, self.count / (np.pi * self.spread * 6)), 48)
        )
        mode: Literal["reflect", "edge"] = "reflect" if min(shape) > margin else "edge"
        padded = np.pad(stack, [(0, 0), (margin, margin), (margin, margin)], mode=mode)
        h, w = (fft.next_fast_len(n) for n in padded.shape[1:])
        spectra = fft.fft2(padded, (h, w), workers=-1)
        out = np.empty((self.count, *shape), np.float32)
        inner = (..., slice(margin, margin + shape[0]), slice(margin, margin + shape[1]))
        for k, transfer in enumerate(self.filters(h, w)):
            answers = fft.ifft2(spectra * transfer, overwrite_x=True, workers=-1)
            out[k] = np.abs(answers[inner]).sum(axis=0)
        return out


@dataclass(frozen=True, eq=False)
class OrientationMap:
    """`angle (H, W)` in [0, π), undirected, from +x towards +y; `confidence (H, W)` in [0, 1].

    Confidence is |Σ r e^{2iθ}| / Σ r over the bank's answers r: 0 for an isotropic answer, near 1
    for a single orientation. It is 0 outside the mask.
    """

    angle: NDArray[np.float32]
    confidence: NDArray[np.float32]


def texture(image: Images, mask: Bools, scale: float = 4.0) -> NDArray[np.float32]:
    """The image's relative detail `(H, W)`: over its mean near by in the mask, less 1.

    The mean is a Gaussian one of `scale` pixels. Detail is 0 outside the mask, so the hair's
    outline and slow shading do not answer as lines.
    """
    inside = mask.astype(np.float32)
    weight = ndimage.gaussian_filter(inside, scale)
    mean = ndimage.gaussian_filter(np.where(mask, image, 0).astype(np.float32), scale)
    floor = 1e-6 * float(np.abs(image[mask]).max(initial=0.0)) + 1e-30
    ratio = image * weight / np.maximum(mean, floor) - 1
    return np.where(mask, np.clip(ratio, -1.0, 3.0), 0.0).astype(np.float32)


def orientations(
    images: Images,
    mask: Bools,
    bank: LogGaborBank = LogGaborBank(),
) -> OrientationMap:
    """The orientation at every pixel of `mask (H, W)` from `images (N, H, W)`, one per lighting.

    Each lighting's winner and confidence are merged as doubled angles (Sun Eq. 2 averages
    π-periodic angles directly; θ and θ + π would cancel), weighted by the answer's strength. A
    winner is refined below the bank's bins by the parabola through its neighbours.
    """
    images = np.asarray(images)
    if images.ndim == 2:
        images = images[None]
    if images.ndim != 3 or images.shape[1:] != mask.shape:
        raise ValueError(
            f"expected images (N, {mask.shape[0]}, {mask.shape[1]}) like the mask, "
            f"got {images.shape}"
        )
    total = np.zeros(mask.shape, np.complex128)
    weight = np.zeros(mask.shape)
    for image in images:
        responses = bank.responses(texture(image, mask))
        angle, confidence = _winner(responses)
        strength = responses.max(axis=0).astype(float)
        total += strength * confidence * np.exp(2j * angle)
        weight += strength
    confidence = np.abs(total) / np.maximum(weight, 1e-12)
    angle = (np.angle(total) / 2) % np.pi
    return OrientationMap(
        angle.astype(np.float32) % np.float32(np.pi),
        np.where(mask, np.clip(confidence, 0, 1), 0).astype(np.float32),
    )


def _winner(responses: NDArray[np.float32]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Angle of the strongest answer, refined below a bin, and the confidence; both `(H, W)`."""
    count = len(responses)
    best = responses.argmax(axis=0)
    left, mid, right = (
        np.take_along_axis(responses, ((best + s) % count)[None], axis=0)[0].astype(float)
        for s in (-1, 0, 1)
    )
    bend = left - 2 * mid + right
    shift = np.where(bend < 0, 0.5 * (left - right) / np.where(bend < 0, bend, -1), 0)
    angle = (best + np.clip(shift, -0.5, 0.5)) * np.pi / count
    phase = np.exp(2j * np.pi * np.arange(count) / count)
    total = np.tensordot(phase, responses, axes=1)
    strength = responses.sum(axis=0, dtype=float)
    said = responses.max(axis=0) > _FAINTEST
    return angle, np.where(said, np.abs(total) / np.maximum(strength, 1e-12), 0.0)

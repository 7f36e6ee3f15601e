"""2D hair orientation in images by a bank of log-Gabor filters (Sun §4.1, Photobooth §3.2)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np
from scipy import fft, ndimage

from reconstruction.arrays import AnyFloats, Array, Bools, Floats, Ints
from reconstruction.reconstruct_options import LogGaborBank

_FAINTEST = 1e-5  # relative detail below this is single-precision rounding


BANDWIDTH = float(np.log(2))  # σ_λ of every filter, natural logarithm


def filters(bank: LogGaborBank, height: int, width: int) -> Iterator[Floats]:
    """The bank's `count` transfer functions `(H, W)`, in the layout of `fft2`.

    exp(−log²(ρλ)/(2σ_λ²)) · exp(−Δ²/(2σ_φ²)): Sun Eq. 13 with the square missing in print; ρ is the
    frequency in cycles per pixel, Δ the angle to the filter's axis. Filter k responds to lines at
    k · 180°/count from +x towards +y, perpendicular to its axis. Filters are one-sided in
    frequency, so that the response magnitude does not depend on the phase of the lines.
    """
    fy = np.fft.fftfreq(height)[:, None]
    fx = np.fft.fftfreq(width)[None, :]
    rho = np.hypot(fx, fy)
    rho[0, 0] = 1.0
    radial = np.exp(-(np.log(rho * bank.wavelength) ** 2) / (2 * BANDWIDTH**2))
    radial[0, 0] = 0.0
    angle = np.arctan2(fy, fx)
    sigma = bank.spread * np.pi / bank.count
    for k in range(bank.count):
        own = k * np.pi / bank.count + np.pi / 2
        delta = (angle - own + np.pi) % (2 * np.pi) - np.pi
        yield np.asarray(radial * np.exp(-(delta**2) / (2 * sigma**2)), np.float32)


def responses(bank: LogGaborBank, images: AnyFloats) -> Floats:
    """Response magnitudes `(count, H, W)` of an image `(H, W)`, mirrored at its edges.

    For a stack `(N, H, W)`, the sum of the magnitudes.
    """
    images = np.asarray(images, np.float32)
    stack = images[None] if images.ndim == 2 else images
    out = np.zeros((bank.count, *stack.shape[1:]), np.float32)
    one = np.empty_like(out)
    for image in stack:
        _respond(bank, image, one)
        out += one
    return out


def _respond(bank: LogGaborBank, image: Floats, out: Floats) -> None:
    """Write the response magnitudes `(count, H, W)` of one image into `out`.

    A filter's frequencies lie in a narrow wedge: only its rows (or columns, if fewer) are
    transformed first, then only the part on the image.
    """
    shape = image.shape
    margin = int(min(4 * bank.wavelength * max(1.0, bank.count / (np.pi * bank.spread * 6)), 48))
    mode: Literal["reflect", "edge"] = "reflect" if min(shape) > margin else "edge"
    padded = np.pad(image, margin, mode=mode)
    h, w = (fft.next_fast_len(n) for n in padded.shape)
    spectrum = fft.fft2(padded, (h, w))
    inner = tuple(slice(margin, margin + n) for n in shape)
    for k, (axis, lines, transfer) in enumerate(_wedges(bank, h, w)):
        some = spectrum.take(lines, axis=1 - axis) * transfer
        some = fft.ifft(some, axis=axis, overwrite_x=True)
        if axis == 1:
            full = np.zeros((h, shape[1]), np.complex64)
            full[lines] = some[:, inner[1]]
            response = fft.ifft(full, axis=0, overwrite_x=True)[inner[0]]
        else:
            full = np.zeros((shape[0], w), np.complex64)
            full[:, lines] = some[inner[0]]
            response = fft.ifft(full, axis=1, overwrite_x=True)[:, inner[1]]
        np.abs(response, out=out[k])


_NEGLIGIBLE = 1e-6  # of a filter's peak: below is single-precision rounding


@lru_cache(maxsize=4)
def _wedges(bank: LogGaborBank, height: int, width: int) -> list[tuple[int, Ints, Floats]]:
    """Each filter's first axis to transform, its nonzero lines, and their values.

    Axis 1 has rows `(R, width)`, axis 0 columns `(height, C)`.
    """
    out = []
    for transfer in filters(bank, height, width):
        there = transfer > _NEGLIGIBLE * transfer.max()
        rows, columns = np.flatnonzero(there.any(axis=1)), np.flatnonzero(there.any(axis=0))
        if len(rows) * width <= len(columns) * height:
            out.append((1, rows, transfer[rows]))
        else:
            out.append((0, columns, np.ascontiguousarray(transfer[:, columns])))
    return out


@dataclass(frozen=True, eq=False)
class OrientationMap:
    """`angle (H, W)` in [0, π), undirected, from +x towards +y; `confidence (H, W)` in [0, 1].

    Confidence is |Σ r e^{2iθ}| / Σ r over the bank's responses r: 0 if isotropic, near 1 for a
    single orientation; 0 outside the mask.
    """

    angle: Floats
    confidence: Floats


def texture(image: AnyFloats, mask: Bools, scale: float = 4.0) -> Floats:
    """Relative detail `(H, W)`: the image over its local mean in the mask, minus 1.

    The mean is Gaussian with `scale` pixels. Detail is 0 outside the mask and in the dark, so that
    outline and shading give no response.
    """
    return _detail_and_mean(image, mask, scale)[0]


def textures(images: Sequence[AnyFloats], masks: Sequence[Bools], scale: float = 4.0) -> Floats:
    """The `texture` of each image `(N, H, W)`, weighted by the root of its local mean.

    Photon noise is the root of the light, so that it is as strong in all of them; without weights
    that of dark images prevails. The weights of a pixel have mean 1.
    """
    out = np.empty((len(images), *masks[0].shape), np.float32)
    weights = np.empty_like(out)
    for k, (image, mask) in enumerate(zip(images, masks, strict=True)):
        out[k], mean = _detail_and_mean(image, mask, scale)
        np.sqrt(mean, out=weights[k])
    out *= weights
    out /= weights.mean(axis=0) + np.float32(1e-30)
    return out


def _detail_and_mean(image: AnyFloats, mask: Bools, scale: float) -> tuple[Floats, Floats]:
    """The texture of an image and its local mean, 0 where there is no texture."""
    inside = mask.astype(np.float32)
    weight = ndimage.gaussian_filter(inside, scale)
    mean = ndimage.gaussian_filter(np.where(mask, image, 0).astype(np.float32), scale)
    floor = 1e-6 * float(np.abs(image[mask]).max(initial=0.0)) + 1e-30
    ratio = image * weight / np.maximum(mean, floor) - 1
    lit = mask & (mean > floor)
    detail = np.where(lit, np.clip(ratio, -1.0, 3.0), 0.0).astype(np.float32)
    return detail, np.where(lit, mean / np.maximum(weight, 1e-30), 0.0).astype(np.float32)


def orientations(
    images: AnyFloats,
    mask: Bools,
    bank: LogGaborBank = LogGaborBank(),
    known: Bools | None = None,
) -> OrientationMap:
    """The orientation at every pixel of `mask (H, W)` from `images (N, H, W)`, one per lighting.

    Responses are summed over lightings, weighted by brightness, before the maximum is taken: lines
    too faint under one light add up. (Sun Eq. 2 averages the maxima.) The isotropic part of the
    sum, caused by noise, does not enter the confidence. Pixels of a lighting that are not `known
    (N, H, W)` (saturated) have no detail. The maximum is refined by a parabola through its
    neighbours.
    """
    images = np.asarray(images)
    if images.ndim == 2:
        images = images[None]
    if images.ndim != 3 or images.shape[1:] != mask.shape:
        wanted = f"(N, {mask.shape[0]}, {mask.shape[1]})"
        raise ValueError(f"expected images {wanted} like the mask, got {images.shape}")
    response = np.empty((bank.count, *mask.shape), np.float32)
    total = np.zeros_like(response)
    bright = float(np.abs(images[:, mask]).mean()) if mask.any() and len(images) else 0.0
    for k, image in enumerate(images):
        local = ndimage.gaussian_filter(np.where(mask, image, 0).astype(np.float32), 4.0)
        lit = np.maximum(local, 0) / max(bright, 1e-30)
        valid = mask if known is None else mask & known[k]
        _respond(bank, texture(image, valid) * lit, response)
        total += response
    significant = total.max(axis=0) > _FAINTEST
    total -= total.min(axis=0)
    angle, confidence = _winner(total)
    confidence = np.where(significant, confidence, 0.0)
    return OrientationMap(
        angle.astype(np.float32) % np.float32(np.pi),
        np.where(mask, np.clip(confidence, 0, 1), 0).astype(np.float32),
    )


def _winner(responses: Floats) -> tuple[Array, Array]:
    """Angle and confidence `(H, W)` of the strongest of the responses `(count, H, W)`."""
    count = len(responses)
    peak = responses[0].copy()
    best = np.zeros(peak.shape, np.int64)
    for k in range(1, count):
        higher = responses[k] > peak
        np.copyto(peak, responses[k], where=higher)
        np.copyto(best, k, where=higher)
    left, right = (
        np.take_along_axis(responses, ((best + s) % count)[None], axis=0)[0].astype(float)
        for s in (-1, 1)
    )
    bend = left - 2.0 * peak + right
    shift = np.where(bend < 0, 0.5 * (left - right) / np.where(bend < 0, bend, -1), 0)
    angle = (best + np.clip(shift, -0.5, 0.5)) * np.pi / count
    phase = 2 * np.pi * np.arange(count) / count
    waves = np.stack([np.cos(phase), np.sin(phase), np.ones(count)]).astype(np.float32)
    real, imaginary, strength = (waves @ responses.reshape(count, -1)).reshape(3, *peak.shape)
    share = np.hypot(real, imaginary) / np.maximum(strength, 1e-12)
    return angle, np.where(peak > _FAINTEST, share, 0.0).astype(float)

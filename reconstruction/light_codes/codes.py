"""Lightcodes: which lights reach a pixel, one bit for each, packed in words (Sun §4.2.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import AnyFloats, Bools, Floats

Words = NDArray[np.uint32]

WORD = 32


@dataclass(frozen=True, eq=False)
class CodeMap:
    """One view's lightcodes.

    `words (H, W, ceil(L / 32)) uint32` hold light `i` in bit `i % 32` of word `i // 32`, 0 outside
    the mask. `varying (words,)` marks the lights whose bit varies over the hair. `threshold` is the
    response from which a pixel counts as lit, `noise` the sensor's. `reached`, packed alike, marks
    the lights of which any light arrives: by reciprocity, a camera beside them sees the pixel.
    `shot (words,)` marks the lights that have a frame.
    """

    words: Words
    reached: Words
    varying: Words
    shot: Words
    threshold: float
    noise: float


def pack(bits: Bools) -> Words:
    """Words `(..., ceil(L / 32))` of `bits (..., L)`; the last word is filled up with zeros."""
    count = bits.shape[-1]
    width = -(-count // WORD) * WORD
    padded = np.zeros((*bits.shape[:-1], width), bool)
    padded[..., :count] = bits
    packed = np.packbits(padded, axis=-1, bitorder="little")
    return np.ascontiguousarray(packed).view("<u4").astype(np.uint32)


def unpack(words: Words, count: int) -> Bools:
    """The `count` bits `(..., count)` of `words (..., W)`; the inverse of `pack`."""
    raw = np.ascontiguousarray(words, dtype="<u4").view(np.uint8)
    return np.unpackbits(raw, axis=-1, bitorder="little", count=count).astype(bool)


def match(a: Words, b: Words, compared: Words) -> Floats:
    """Share of equal bits among those `compared`: `(...)` of `(..., W)` words; 1 without any."""
    equal = np.bitwise_count(~(a ^ b) & compared).sum(axis=-1, dtype=np.int64)
    total = np.bitwise_count(compared).sum(axis=-1, dtype=np.int64)
    share = np.divide(equal, total, out=np.ones(np.broadcast(equal, total).shape), where=total > 0)
    return share.astype(np.float32)


LEAST_LIT = 0.1  # of the median pixel's brightest light: above light in shadow

LEAST_REACHED = 0.02
"""Of a light's 95th percentile on the hair; a common threshold would take shading for shadow."""


def along_lines(images: Floats, angle: AnyFloats, half: int = 4) -> Floats:
    """Means of `images (L, H, W)` over `half` pixels to both sides along the line at each pixel:
    shadows extend along strands, noise does not."""
    y, x = np.mgrid[: angle.shape[0], : angle.shape[1]]
    total = np.zeros_like(images)
    for k in range(-half, half + 1):
        column = np.clip(np.rint(x + k * np.cos(angle)).astype(int), 0, angle.shape[1] - 1)
        row = np.clip(np.rint(y + k * np.sin(angle)).astype(int), 0, angle.shape[0] - 1)
        total += images[:, row, column]
    return total / np.float32(2 * half + 1)


def code_map(
    responses: AnyFloats,
    mask: Bools,
    furthest: int,
    noise: float = 0.0,
    saturated: Bools | None = None,
    shot: Bools | None = None,
) -> CodeMap:
    """Lightcodes from responses `(L, H, W)` to single lights of equal irradiance on the subject.

    A pixel is lit above the median over the mask `(H, W)` under light `furthest`, the one furthest
    from the camera (a shadow), above three times `noise`, the responses' standard deviation, and
    above `LEAST_LIT`. It is reached by a light above `LEAST_REACHED` and the noise. `saturated (L,
    H, W)` pixels are both. Bits are 0 for lights without a frame, `shot (L,)`, by default all have
    one. Raises `ValueError` where shapes disagree.
    """
    if responses.ndim != 3 or responses.shape[1:] != mask.shape:
        raise ValueError(f"expected responses (L, {mask.shape}), got {responses.shape}")
    shot = np.ones(len(responses), bool) if shot is None else shot
    shadow = float(np.median(responses[furthest][mask])) if mask.any() else 0.0
    brightest = responses.max(axis=0)[mask]
    faint = LEAST_LIT * float(np.median(brightest)) if len(brightest) else 0.0
    threshold = max(shadow, 3 * noise, faint, 0.0)
    lit = (responses > threshold) & mask
    full = np.array([np.percentile(r[mask], 95) if mask.any() else 0.0 for r in responses])
    least = np.maximum(LEAST_REACHED * full, 3 * noise)
    reached = (responses > least[:, None, None]) & mask
    lit &= shot[:, None, None]
    reached &= shot[:, None, None]
    if saturated is not None:
        lit |= saturated & mask
        reached |= saturated & mask
    bits = np.moveaxis(lit, 0, -1)
    inside = bits[mask]
    varying = np.asarray(inside.any(axis=0) & ~inside.all(axis=0))
    reaching = pack(np.moveaxis(reached, 0, -1))
    return CodeMap(pack(bits), reaching, pack(varying), pack(shot), threshold, noise)

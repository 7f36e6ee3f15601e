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
    the mask. `varying (words,)` marks the lights whose bit is not the same all over the hair: the
    others say nothing within this view. `threshold` is the response at which a pixel counts as
    lit, `noise` the part of it that the sensor's noise asked for. `reached`, packed alike, marks
    the lights of which anything arrives: by reciprocity, what stands beside them sees the pixel.
    `shot (words,)` marks the lights of which there is a frame: of the others nothing is known.
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


def match(a: Words, b: Words, asked: Words) -> Floats:
    """Share of equal bits among those `asked`: `(...)` of `(..., W)` words; 1 where none is."""
    equal = np.bitwise_count(~(a ^ b) & asked).sum(axis=-1, dtype=np.int64)
    total = np.bitwise_count(asked).sum(axis=-1, dtype=np.int64)
    share = np.divide(equal, total, out=np.ones(np.broadcast(equal, total).shape), where=total > 0)
    return share.astype(np.float32)


LEAST_LIT = 0.1  # of the median pixel's brightest light: what a shadow lets through is below

LEAST_REACHED = 0.02
"""Of what a light brings to the brightest twentieth of the hair.

One threshold for all lights takes shading for shadow: where hair scatters a light away from the
camera, what stands beside that light counted as hidden though it sees the pixel.
"""


def along_lines(images: Floats, angle: AnyFloats, half: int = 4) -> Floats:
    """Means of `images (L, H, W)` over `half` pixels to both sides along the line at each pixel.

    Shadows run along strands for some millimetres, noise does not; across a strand they change.
    """
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

    A pixel is lit where it exceeds the median over the mask `(H, W)` under light `furthest`, the
    one furthest from the camera, which shows what a shadow looks like; and three times `noise`,
    the responses' standard deviation; and `LEAST_LIT`, where the head itself stands before that
    light and its median is next to nothing. It is reached by a light that brings it `LEAST_REACHED`
    and more than the noise. `saturated (L, H, W)` pixels are both whatever their value. `shot (L,)`
    says of which lights there is a frame (all): the others' bits are 0. Raises `ValueError` where
    shapes disagree.
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

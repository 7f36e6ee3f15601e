"""Pictures as the DLPC900 stores them: 24 patterns in an image, enhanced run-length encoding.

Source: DLPC900 Programmer's Guide, TI DLPU018 revision I (November 2023), sections 2.4.2 (image
header, table 2-109) and 2.4.3.2 (enhanced RLE, with the example of table 2-113). That the count of
two bytes has its low bits first, and bits 23 to 16 of a pixel go first, is as TI's host software
has it; the guide's example calls `82 01` 513, which its own rule makes 130.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from stage_service.devices.projectors.dlpc900 import BITS

Image = npt.NDArray[np.uint32]
"""(H, W), 24 bits a pixel: bit b belongs to the pattern with bit position b. Row 0 is on top."""

_ENHANCED_RLE = 2
_LONGEST = 0x7FFF
_END_OF_IMAGE = b"\x00\x01\x00"


def composite(patterns: Sequence[npt.NDArray[np.bool_]]) -> Image:
    """Put up to 24 patterns, (H, W) each, into one image: pattern b into bit b."""
    if not 1 <= len(patterns) <= BITS:
        raise ValueError(f"an image holds 1 to {BITS} patterns of one bit, got {len(patterns)}")
    image = np.zeros(patterns[0].shape, np.uint32)
    for bit, pattern in enumerate(patterns):
        image |= pattern.astype(np.uint32) << np.uint32(bit)
    return image


def scanlines(rows: Sequence[int], height: int, width: int) -> Image:
    """`composite` of up to 24 scanlines: pattern b is row `rows[b]`, the rest of it dark."""
    if not 1 <= len(rows) <= BITS or not all(0 <= row < height for row in rows):
        raise ValueError(f"1 to {BITS} rows from 0 to {height - 1}, got {list(rows)}")
    lines = np.zeros((height, 1), np.uint32)
    for bit, row in enumerate(rows):
        lines[row] |= np.uint32(1 << bit)
    return np.broadcast_to(lines, (height, width))


def encode(image: Image) -> bytes:
    """The 48-byte header and the compressed image; raises `ValueError` beyond 24 bits."""
    height, width = image.shape
    if int(image.max()) >> BITS or not 1 <= width <= _LONGEST:
        raise ValueError(f"{BITS} bits a pixel and at most {_LONGEST} columns are encoded")
    alike = np.concatenate(([False], (image[1:] == image[:-1]).all(axis=1)))
    lines = (
        b"\x00\x01" + _count(width) if alike[y] else encode_line(image[y], image[y - 1 : y].ravel())
        for y in range(height)
    )
    data = b"".join(lines) + _END_OF_IMAGE
    header = (
        b"Spld"
        + width.to_bytes(2, "little")
        + height.to_bytes(2, "little")
        + len(data).to_bytes(4, "little")
        + b"\xff" * 8
        + bytes((0, 0, 0, 0, 0, _ENHANCED_RLE, 1))
    )
    return header.ljust(48, b"\0") + data


def encode_line(line: Image, previous: Image) -> bytes:
    """One line, (W,), after the line `previous`, empty for the first.

    Longest first: what is equal to the line above is copied, what repeats is repeated, the rest
    is written as it is. No end-of-line code: a full line ends by itself.
    """
    width = len(line)
    repeats = _run_lengths(line[1:] == line[:-1]) + 1
    above = np.zeros(width, bool)
    above[: len(previous)] = line[: len(previous)] == previous[:width]
    copies = _run_lengths(above)[:width]
    encoded = bytearray()
    x = raw = 0
    while x < width:
        copy, repeat = int(copies[x]), int(repeats[x])
        if copy < repeat == 1:
            x, raw = x + 1, raw + 1
            continue
        encoded += _raw(line[x - raw : x])
        raw = 0
        if copy >= repeat:
            encoded += b"\x00\x01" + _count(copy)
        else:
            encoded += _count(repeat) + _pixels(line[x : x + 1])
        x += max(copy, repeat)
    return bytes(encoded + _raw(line[x - raw : x]))


def _run_lengths(equal: npt.NDArray[np.bool_]) -> npt.NDArray[np.int64]:
    """For each i of 0 … n, how many of `equal`, (n,), are true from i on without a gap."""
    n = len(equal)
    ends = np.append(np.where(equal, n, np.arange(n)), n)
    nearest = np.minimum.accumulate(ends[::-1])[::-1]
    return nearest - np.arange(n + 1)


def _raw(pixels: Image) -> bytes:
    # 00 01 means a copy: one pixel is written as repeated once.
    if not len(pixels):
        return b""
    return (b"" if len(pixels) == 1 else b"\0") + _count(len(pixels)) + _pixels(pixels)


def _pixels(pixels: Image) -> bytes:
    """Most significant byte, bits 23 … 16, first."""
    return pixels.astype(">u4").view(np.uint8).reshape(-1, 4)[:, 1:].tobytes()


def _count(n: int) -> bytes:
    """1 … 127 in a byte; from 128 on its low 7 bits with the top bit set, then the rest."""
    return bytes((n,)) if n < 128 else bytes((n & 0x7F | 0x80, n >> 7))

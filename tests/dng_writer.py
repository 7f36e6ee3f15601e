"""Writes a sensor's mosaic as DNG (Adobe's specification 1.4); it shares nothing with us."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

RED, GREEN, BLUE = 0, 1, 2
RGGB = (RED, GREEN, GREEN, BLUE)
BLACK, WHITE = 64, 65535
BYTE, ASCII, SHORT, LONG, SRATIONAL = 1, 2, 3, 4, 10
SIZES = {BYTE: 1, ASCII: 1, SHORT: 2, LONG: 4, SRATIONAL: 8}
STRIP_OFFSETS = 273


def write_dng(
    path: Path, values: np.ndarray, mosaic: tuple[int, ...] = RGGB, black: int = BLACK
) -> None:
    """Write `values (H, W)`, 16 bits, not compressed, as a sensor with this `mosaic` gives them.

    `mosaic`: the colours of its first two rows. LibRaw refuses pictures of a few pixels a side.
    """
    height, width = values.shape
    name = b"none\0"
    matrix = struct.pack("<18i", *(n for i in range(9) for n in (int(i % 4 == 0), 1)))
    tags = [
        (254, LONG, _longs(0)),  # the whole picture
        (256, LONG, _longs(width)),
        (257, LONG, _longs(height)),
        (258, SHORT, _shorts(16)),  # bits
        (259, SHORT, _shorts(1)),  # not compressed
        (262, SHORT, _shorts(32803)),  # a mosaic
        (271, ASCII, name),
        (272, ASCII, name),
        (STRIP_OFFSETS, LONG, _longs(0)),
        (274, SHORT, _shorts(1)),  # upright
        (277, SHORT, _shorts(1)),  # samples a pixel
        (278, LONG, _longs(height)),  # rows a strip
        (279, LONG, _longs(2 * values.size)),
        (284, SHORT, _shorts(1)),  # planes
        (33421, SHORT, _shorts(2, 2)),  # the mosaic's size,
        (33422, BYTE, bytes(mosaic)),  # and its colours
        (50706, BYTE, bytes([1, 4, 0, 0])),  # DNG's version,
        (50707, BYTE, bytes([1, 1, 0, 0])),  # and the oldest that reads it
        (50708, ASCII, name),
        (50714, LONG, _longs(black)),
        (50717, LONG, _longs(WHITE)),
        (50721, SRATIONAL, matrix),  # XYZ to the sensor's colours
        (50778, SHORT, _shorts(21)),  # of D65
    ]
    behind = 8 + 2 + 12 * len(tags) + 4
    pixels = behind + sum(len(_even(data)) for _, _, data in tags if len(data) > 4)
    entries, far = b"", b""
    for tag, kind, data in tags:
        held = _longs(pixels) if tag == STRIP_OFFSETS else data
        if len(held) > 4:
            where, far = _longs(behind + len(far)), far + _even(held)
        else:
            where = held.ljust(4, b"\0")
        entries += struct.pack("<HHI", tag, kind, len(held) // SIZES[kind]) + where
    head = struct.pack("<2sHIH", b"II", 42, 8, len(tags))
    path.write_bytes(head + entries + bytes(4) + far + values.astype("<u2").tobytes())


def _longs(*numbers: int) -> bytes:
    return struct.pack(f"<{len(numbers)}I", *numbers)


def _shorts(*numbers: int) -> bytes:
    return struct.pack(f"<{len(numbers)}H", *numbers)


def _even(data: bytes) -> bytes:
    return data + b"\0" * (len(data) % 2)

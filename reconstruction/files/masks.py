"""Masks as grey PNG."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Bools
from reconstruction.containment import plain_file

_LENGTH = struct.Struct(">I")
_SIZE = struct.Struct(">II")
_COLOUR_TYPE = 25  # where a PNG says what its pixels are
_MAYBE_TRANSPARENT = (3, 4, 6)  # a palette, grey or colour with alpha
AS_STORED = cv2.IMREAD_IGNORE_ORIENTATION
"""Cameras are those of the pixels as a file has them: EXIF says how viewers turn them."""
_PIECE = 4096  # packed bytes that are unpacked at a time: to 4 MB at most
_WIDEST = 8  # bytes of a pixel: four channels of 16 bits
ALIKE = 0.9
"""Of the pixels of either that are of both, where two masks are one: soft edges differ."""


def read_mask(path: Path, width: int, height: int) -> Bools:
    """Where a grey PNG of that size is half grey and above `(height, width)`.

    Raises `FileNotFoundError`, and `ValueError` naming the file and what is wrong.
    """
    data = plain_file(path).read_bytes()
    try:
        return decode_mask(data, width, height)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def decode_mask(data: bytes, width: int, height: int) -> Bools:
    """`read_mask` of a file's bytes; the `ValueError` names no file.

    What the file says of its sizes is held against them before anything is made that large.
    """
    expected = f"expected a PNG of {width}x{height} pixels"
    if not data.startswith(b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR") or len(data) < 24:
        raise ValueError(f"{expected}, got another file")
    if (found := _SIZE.unpack_from(data, 16)) != (width, height):
        raise ValueError(f"{expected}, got {found[0]}x{found[1]}")
    end, packed = 8, list[memoryview]()
    while end + _LENGTH.size <= len(data):
        length = _LENGTH.unpack_from(data, end)[0]
        if data[end + 4 : end + 8] == b"IDAT":
            packed.append(memoryview(data)[end + 8 : end + 8 + length])
        end += 12 + length  # a chunk's own three words, and its data
    if end <= len(data) and _exceeds(packed, 2 * height * (width * _WIDEST + 1)):
        raise ValueError(f"{expected}, got one with more data than so many pixels have")
    image: NDArray[np.uint8] | None = None
    if end <= len(data):
        image = cv2.imdecode(np.frombuffer(data, np.uint8), AS_STORED | cv2.IMREAD_GRAYSCALE)
    if image is None or image.shape != (height, width):
        raise ValueError(f"{expected}, got one that is damaged")
    mask = half_grey(image)
    if data[_COLOUR_TYPE] in _MAYBE_TRANSPARENT:
        check_alpha(data, mask)
    return mask


def _exceeds(packed: Iterable[memoryview], most: int) -> bool:
    """Whether a zlib stream, in parts, unpacks to more than `most` bytes; holds few of them."""
    stream = zlib.decompressobj()
    for part in packed:
        for begin in range(0, len(part), _PIECE):
            try:
                most -= len(stream.decompress(part[begin : begin + _PIECE]))
            except zlib.error:
                return False  # the reader says what is wrong with it
            if most < 0 or stream.eof:
                return most < 0
    return False


def half_grey(image: NDArray[np.uint8]) -> Bools:
    """Where a grey picture `(H, W)` is half grey and above.

    Raises `ValueError` where nothing is, though not all is black, as of labels 0 and 1.
    """
    brightest = int(image.max(initial=0))
    if 0 < brightest < 128:
        raise ValueError(
            f"shows nothing: half grey (128) and above is taken, its brightest pixel is {brightest}"
            ": write white (255) for a label"
        )
    return np.asarray(image >= 128)


def check_alpha(data: bytes, mask: Bools) -> None:
    """Raise `ValueError` where the alpha of a file's bytes is another mask than its grey `(H, W)`.

    Nobody could say which of the two is meant.
    """
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or image.shape != (*mask.shape, 4):
        return
    opaque = image[..., 3] > np.iinfo(image.dtype).max // 2
    either = (opaque | mask).sum()
    if not opaque.all() and (opaque & mask).sum() < ALIKE * either:
        raise ValueError(
            f"is {opaque.mean():.0%} opaque and, alpha aside, {mask.mean():.0%} half grey and "
            "above: write a grey PNG without alpha, white where the mask is"
        )

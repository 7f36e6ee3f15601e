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
_COLOUR_TYPE = 25  # offset of a PNG's colour type
_MAYBE_TRANSPARENT = (3, 4, 6)  # a palette, grey or colour with alpha
AS_STORED = cv2.IMREAD_IGNORE_ORIENTATION
"""Ignore EXIF rotation: cameras refer to the stored pixels."""
_PIECE = 4096  # compressed bytes decompressed at a time, to at most 4 MB
_WIDEST = 8  # bytes of a pixel of four 16-bit channels
ALIKE = 0.9
"""Least overlap (intersection over union) of equal masks with soft edges."""


def read_mask(path: Path, width: int, height: int) -> Bools:
    """Pixels `(height, width)` of a grey PNG that are half grey and above.

    Raises `FileNotFoundError`, and `ValueError` naming the file and the error.
    """
    data = plain_file(path).read_bytes()
    try:
        return decode_mask(data, width, height)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def decode_mask(data: bytes, width: int, height: int) -> Bools:
    """`read_mask` of a file's bytes; the `ValueError` names no file.

    The sizes in the header are checked before any allocation.
    """
    expected = f"expected a PNG of {width}x{height} pixels"
    if not data.startswith(b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR") or len(data) < 24:
        raise ValueError(f"{expected}, got another file")
    if (found := _SIZE.unpack_from(data, 16)) != (width, height):
        raise ValueError(f"{expected}, got {found[0]}x{found[1]}")
    end, packed = 8, list[memoryview]()
    for kind, begin, length in _chunks(data):
        if kind == b"IDAT":
            packed.append(memoryview(data)[begin : begin + length])
        end = begin + length + 4  # after the checksum
    if end <= len(data) and _exceeds(packed, 2 * height * (width * _WIDEST + 1)):
        raise ValueError(f"{expected}, got a file with more data than these pixels need")
    image: NDArray[np.uint8] | None = None
    if end <= len(data):
        image = cv2.imdecode(np.frombuffer(data, np.uint8), AS_STORED | cv2.IMREAD_GRAYSCALE)
    if image is None or image.shape != (height, width):
        raise ValueError(f"{expected}, got a damaged file")
    if (turn := exif_orientation(png_chunks(data).get(b"eXIf", b""))) != 1:
        raise ValueError(f"EXIF orientation {turn}: write the mask in the camera's pixels")
    mask = half_grey(image)
    if data[_COLOUR_TYPE] in _MAYBE_TRANSPARENT:
        check_alpha(data, mask)
    return mask


def _chunks(data: bytes) -> Iterable[tuple[bytes, int, int]]:
    """Kind, begin and length of each chunk's data."""
    at = 8
    while at + _LENGTH.size <= len(data):
        length = _LENGTH.unpack_from(data, at)[0]
        yield data[at + 4 : at + 8], at + 8, length
        at += 12 + length


def png_chunks(data: bytes) -> dict[bytes, bytes]:
    """The data of a PNG's chunks other than pixels, the first of each kind."""
    found: dict[bytes, bytes] = {}
    for kind, begin, length in _chunks(data):
        if kind != b"IDAT":
            found.setdefault(kind, data[begin : begin + length])
    return found


def exif_orientation(exif: bytes) -> int:
    """Orientation 1 to 8 of EXIF data; 1 without."""
    order = {b"II": "<", b"MM": ">"}.get(exif[:2])
    try:
        first = struct.unpack_from(f"{order}I", exif, 4)[0] if order else len(exif)
        count = struct.unpack_from(f"{order}H", exif, first)[0] if order else 0
        entries = [
            struct.unpack_from(f"{order}HHIH", exif, first + 2 + 12 * i) for i in range(count)
        ]
    except struct.error:
        return 1
    return next((value for tag, _, _, value in entries if tag == 274 and 1 <= value <= 8), 1)


def _exceeds(packed: Iterable[memoryview], most: int) -> bool:
    """Whether a zlib stream, in parts, decompresses to more than `most` bytes, in little memory."""
    stream = zlib.decompressobj()
    for part in packed:
        for begin in range(0, len(part), _PIECE):
            try:
                most -= len(stream.decompress(part[begin : begin + _PIECE]))
            except zlib.error:
                return False  # the decoder reports it
            if most < 0 or stream.eof:
                return most < 0
    return False


def half_grey(image: NDArray[np.uint8]) -> Bools:
    """Pixels of a grey image `(H, W)` that are half grey and above.

    Raises `ValueError` if there are none but the image is not black, as with labels 0 and 1.
    """
    brightest = int(image.max(initial=0))
    if 0 < brightest < 128:
        raise ValueError(
            f"is empty: its brightest pixel is {brightest}, expected 128 or more for mask pixels: "
            "write white (255)"
        )
    return np.asarray(image >= 128)


def check_alpha(data: bytes, mask: Bools) -> None:
    """Raise `ValueError` if the alpha in a file's bytes contradicts its grey `mask (H, W)`."""
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None or image.shape != (*mask.shape, 4):
        return
    opaque = image[..., 3] > np.iinfo(image.dtype).max // 2
    either = (opaque | mask).sum()
    if not opaque.all() and (opaque & mask).sum() < ALIKE * either:
        raise ValueError(
            f"is {opaque.mean():.0%} opaque, but {mask.mean():.0%} of its pixels are half grey and "
            "above: write a grey PNG without alpha, white for mask pixels"
        )

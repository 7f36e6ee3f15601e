"""What a TIFF or DNG file says of its values, beyond what its readers apply."""

from __future__ import annotations

import logging
import struct
from collections.abc import Mapping
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import tifffile

from reconstruction.arrays import Array
from reconstruction.files.colour import REC709, Colour, to_rec709

logging.getLogger("tifffile").setLevel(logging.CRITICAL)  # damage is reported by the readers
_MOSAIC = 32803
_READ = {0, 1, 2, 3, 6, _MOSAIC}
"""PhotometricInterpretation: grey, RGB, palette, YCbCr, a mosaic."""
_REQUIRED = {1: "WarpRectilinear", 2: "WarpFisheye", 3: "FixVignetteRadial", 9: "GainMap"}
"""Opcodes of DNG that change place or scale."""
_NEEDED = {256, 257, 262}
"""Width, height, PhotometricInterpretation."""
MOST_TAG, MOST_PAGES = 1 << 16, 8
Tags = Mapping[int, Any]


def tags_of(path: Path, mosaic: bool = False) -> Tags:
    """Tags by number of the file's image, or of its full-size `mosaic`. Raises `ValueError` for
    several images and for missing tags or strips."""
    with tifffile.TiffFile(path) as file:
        pages = [
            page
            for top in islice(file.pages, MOST_PAGES)  # a wrong offset leads to thousands
            for page in (top, *islice(getattr(top, "pages", None) or (), MOST_PAGES))
        ]
        tagged = [_tags(page) for page in pages]
        whole = [k for k, t in enumerate(tagged) if not int(t.get(254, 0)) & 1]
        if mosaic:
            whole = [k for k in whole if tagged[k].get(262) == _MOSAIC]
            if not whole:
                found = tagged[0].get(262)
                raise ValueError(f"PhotometricInterpretation {found}: expected a mosaic, 32803")
        elif whole != [0]:
            raise ValueError(f"{len(pages)} images: write one image in a file")
        page, tags = pages[whole[0]], tagged[whole[0]]
        codes = [int(t.code) for t in page.tags]
        if twice := sorted(n for n in codes if codes.count(n) > 1):
            raise ValueError(f"TIFF tag {twice[0]} occurs twice: write the file anew")
        needed = _NEEDED | {277, 33422} if mosaic else _NEEDED
        missing = [n for n in needed if np.size(tags.get(n, ())) == 0]
        if missing:
            raise ValueError(f"TIFF tag {missing[0]} is missing or damaged: write the file anew")
        if len(page.dataoffsets) != np.prod(page.chunked):
            raise ValueError(f"{len(page.dataoffsets)} strips, expected {np.prod(page.chunked)}")
        _check_place(page)
    return {**tagged[0], **tags}


def _check_place(page: Any) -> None:
    """Raise `ValueError` for a strip or tile that begins or ends in the header or a tag."""
    first = np.array(page.dataoffsets, np.int64)
    end = first + np.array(page.databytecounts, np.int64)
    taken = [(0, 8), *((t.offset, 12) for t in page.tags)]
    taken += [(t.valueoffset, t.valuebytecount) for t in page.tags]
    for at, size in taken:
        wrong = (first < at + size) & (end > at)
        if wrong.any():
            raise ValueError(
                f"StripOffsets {first[wrong][0]}: these pixels lie on the file's own tags: write "
                "the file anew"
            )


def tiff_values(tags: Tags, values: Any) -> tuple[Any, float | None, Colour]:
    """`values` with white high, the white of fewer bits than the type's, and their colour."""
    kind = int(tags[262])
    if kind not in _READ:
        raise ValueError(f"PhotometricInterpretation {kind}: write RGB or grey")
    whole = np.issubdtype(values.dtype, np.integer)
    if kind == 0:
        if not whole:
            raise ValueError("PhotometricInterpretation 0 (white is zero) of floats: write 1")
        if values.dtype != np.uint8:  # OpenImageIO has inverted those
            values = np.iinfo(values.dtype).max - values
    if 301 in tags or 291 in tags:
        raise ValueError("TransferFunction or GrayResponseCurve: write linear values without it")
    most = np.max(tags.get(281, tags.get(341, 0)))  # "for statistical purposes", but bits
    white = None
    if whole and 0 < most < np.iinfo(values.dtype).max and (int(most) + 1) & int(most) == 0:
        white = float(most)
        if kind == 0:
            values = values - values.dtype.type(np.iinfo(values.dtype).max - most)
        if values.max(initial=0) > most:
            raise ValueError(f"MaxSampleValue {most}, but values up to {values.max()}: remove it")
    primaries = [*_numbers(tags, 319, REC709[:6]), *_numbers(tags, 318, REC709[6:])]
    return values, white, Colour(None, to_rec709(primaries))


def dng_crop(path: Path) -> tuple[float, float, float, float] | None:
    """Left, top, width and height of DefaultCropOrigin and DefaultCropSize, in the active area of
    a DNG; None without them. Raises `ValueError`."""
    tags = tags_of(path, mosaic=True)
    if 50719 not in tags or 50720 not in tags:
        return None
    (left, top), (width, height) = _numbers(tags, 50719, ()), _numbers(tags, 50720, ())
    return left, top, width, height


def dng_levels(path: Path, shape: tuple[int, int], colours: Any) -> tuple[Array, Array]:
    """Black and white `(H, W)` of a DNG's mosaic of `shape`, whose pixels have the `colours` 0, 1,
    2 and 3 (a second green). Raises `ValueError` for levels that do not fit it.

    Black is the repeated BlackLevel plus BlackLevelDeltaH of the column and BlackLevelDeltaV of the
    row (DNG 1.7, "BlackLevel").
    """
    tags, (height, width) = tags_of(path, mosaic=True), shape
    for code in (51008, 51009, 51022):
        _check_opcodes(code, tags.get(code, b""))
    top, left = (int(n) for n in _numbers(tags, 50829, (0, 0))[:2])
    if top % 2 or left % 2:  # LibRaw would leave out a line, and read another colour's black
        raise ValueError(
            f"ActiveArea begins at row {top}, column {left}: expected even numbers: develop it to "
            "a linear 16-bit TIFF"
        )
    if (np.diff(_numbers(tags, 50712, ())) < 0).any():  # LibRaw has applied it
        raise ValueError("LinearizationTable decreases: develop it to a linear 16-bit TIFF")
    bits, mosaic = _numbers(tags, 258, ()), tags[33422]
    if len(bits) != 1 or not 8 <= bits[0] <= 16 or set(mosaic) - {0, 1, 2}:
        raise ValueError(f"BitsPerSample {bits}, CFAPattern {list(mosaic)}: expected 8 to 16, RGB")
    rows, columns = (int(n) for n in _numbers(tags, 50713, (1, 1)))
    level = np.array(_numbers(tags, 50714, (0,) * (rows * columns)))
    across, down = (np.array(_numbers(tags, code, ())) for code in (50715, 50716))
    for name, found, expected in (
        ("BlackLevel", level, (rows * columns,)),
        ("BlackLevelDeltaH", across, (0, width)),
        ("BlackLevelDeltaV", down, (0, height)),
    ):
        if len(found) not in expected or not np.isfinite(found).all():
            raise ValueError(f"{name} has {len(found)} values: expected {expected[-1]}")
    black = np.tile(level.reshape(rows, columns), (-(-height // rows), -(-width // columns)))
    black = black[:height, :width] + (across if len(across) else 0)
    black = black + (down[:, None] if len(down) else 0)
    white = np.array(_numbers(tags, 50717, (2 ** bits[0] - 1,)))
    if len(white) not in (1, 3, 4):
        raise ValueError(f"WhiteLevel has {len(white)} values: expected 1, 3 or 4")
    by_colour = white if len(white) == 4 else np.resize(np.append(white, white[1:2]), 4)
    return black, np.asarray(by_colour[colours])


def _check_opcodes(code: int, data: bytes) -> None:
    """Raise `ValueError` for an opcode that a reader must apply (DNG 1.7, chapter 7)."""
    at, name = 4, {51008: "OpcodeList1", 51009: "OpcodeList2", 51022: "OpcodeList3"}[code]
    while at + 16 <= len(data):
        number, _, flags, size = struct.unpack_from(">4I", data, at)
        if number in _REQUIRED and not flags & 1:
            raise ValueError(f"{name} has {_REQUIRED[number]}: develop it to a linear 16-bit TIFF")
        at += 16 + size


def _tags(page: Any) -> dict[int, Any]:
    """Values by tag, rationals as quotients."""
    out = {}
    for tag in page.tags:
        if tag.count <= MOST_TAG:
            value = tag.value
            if tag.dtype in (5, 10):  # RATIONAL, SRATIONAL
                pairs = np.reshape(value, (-1, 2)).astype(float)
                with np.errstate(divide="ignore", invalid="ignore"):
                    value = tuple(pairs[:, 0] / pairs[:, 1])
            out[int(tag.code)] = value
    return out


def _numbers(tags: Tags, code: int, default: Any) -> list[float]:
    return [float(x) for x in np.atleast_1d(tags.get(code, default))]

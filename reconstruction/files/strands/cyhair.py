"""cyHair `.hair` files (Cem Yuksel, www.cemyuksel.com/research/hairmodels).

A 128-byte little-endian header, then the arrays in its flags, in this order: segments per strand
(uint16), points (3 float32), thickness, transparency (float32 per point) and colour (3 float32 per
point). `thickness` is twice the radius. Transparency and colour are not read. The magics "HAIR" (of
the specification) and "hair" are read, "HAIR" is written.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from reconstruction.files.durable import writing
from reconstruction.files.strands.errors import StrandFileError, require_finite
from reconstruction.geometry.strands import Strands

HEADER = struct.Struct("<4s4I5f88s")
SEGMENTS, POINTS, THICKNESS, TRANSPARENCY, COLOUR = 1, 2, 4, 8, 16
MOST_SEGMENTS = 65535
INFORMATION = b"hairstage: metres, z up, roots first; thickness is twice the radius"


def read_hair(path: Path) -> Strands:
    """Read a `.hair` file; strands without a segment are skipped.

    A missing or non-positive thickness becomes the default radius.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(HEADER.size)
        if len(head) < HEADER.size:
            raise StrandFileError(f"{len(head)} bytes, a .hair header has {HEADER.size}: truncated")
        magic, strands, points, flags, default_segments, thickness, *_ = HEADER.unpack(head)
        if magic.upper() != b"HAIR":
            raise StrandFileError(f"not a .hair file, it begins with {magic!r}")
        if not flags & POINTS:
            raise StrandFileError(f"the header's flags {flags:#x} announce no points")
        if flags >> 5:
            raise StrandFileError(f"the header's flags {flags:#x} have unknown bits set")
        needed = HEADER.size + 2 * strands * bool(flags & SEGMENTS)
        per_point = 12 + 4 * bool(flags & THICKNESS) + 4 * bool(flags & TRANSPARENCY)
        needed += points * (per_point + 12 * bool(flags & COLOUR))
        if needed > size:
            raise StrandFileError(
                f"truncated, or its counts are wrong: {strands} strands with {points} "
                f"points need {needed} bytes, the file has {size}"
            )
        if flags & SEGMENTS:
            segments = np.frombuffer(file.read(2 * strands), "<u2").astype(np.int64)
        elif strands * (default_segments + 1) == points:
            segments = np.full(strands, default_segments, np.int64)
        else:
            raise StrandFileError(
                f"{strands} strands of the default {default_segments} segments do not "
                f"make {points} points"
            )
        if segments.sum() + strands != points:
            raise StrandFileError(
                f"the segments make {segments.sum() + strands} points, the header says {points}"
            )
        start = file.tell()
        xyz = np.frombuffer(file.read(12 * points), "<f4").reshape(-1, 3)
        require_finite(xyz, range(start, start + 12 * points, 12))
        width = np.full(points, thickness, np.float32)
        if flags & THICKNESS:
            width = np.frombuffer(file.read(4 * points), "<f4")
    keep = np.repeat(segments > 0, segments + 1)
    counts = (segments + 1)[segments > 0]
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return Strands(xyz[keep], offsets, _radius(width[keep]))


def _radius(width: np.ndarray) -> float | np.ndarray:
    """Radii from widths: a scalar if all are equal, the default if invalid."""
    if len(width) == 0 or not (np.isfinite(width).all() and (width > 0).all()):
        return 4e-5
    half = (width / 2).astype(np.float32)
    return float(half[0]) if (half == half[0]).all() else half


def write_hair(path: Path, strands: Strands) -> None:
    """Write a `.hair` file; raises `StrandFileError` for strands of over 65,535 segments."""
    segments = np.diff(strands.offsets) - 1
    if len(segments) and segments.max() > MOST_SEGMENTS:
        raise StrandFileError(
            f"{path}: strand {segments.argmax()} has {segments.max()} segments, .hair holds at "
            f"most {MOST_SEGMENTS}: resample it"
        )
    if len(strands.points) >= 2**32:
        raise StrandFileError(f"{path}: .hair holds under 2^32 points, got {len(strands.points)}")
    vary = isinstance(strands.radius, np.ndarray)
    width = 2 * np.asarray(strands.radius, np.float32)
    flags = SEGMENTS | POINTS | (THICKNESS if vary else 0)
    thickness = float(width.mean()) if width.size else 8e-5
    numbers = len(strands), len(strands.points), flags, 0, thickness, 0.0, 0.5, 0.5, 0.5
    header = HEADER.pack(b"HAIR", *numbers, INFORMATION)
    with writing(path) as temporary, temporary.open("wb") as file:
        file.write(header + segments.astype("<u2").tobytes())
        file.write(strands.points.astype("<f4").tobytes())
        if vary:
            file.write(width.astype("<f4").tobytes())

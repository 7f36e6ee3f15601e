"""cyHair `.hair` files (Cem Yuksel, www.cemyuksel.com/research/hairmodels).

A 128-byte little-endian header, then the arrays in its flags, in this order: segments per strand
(uint16), points (3 float32), thickness, transparency (float32 per point) and colour (3 float32 per
point). `thickness` is twice the radius. Transparency and colour are not read. The magics "HAIR" (of
the specification) and "hair" are read, "HAIR" is written.

Without a header, as MonoHair and others write them, and of exactly the size that its counts need:
strands and points (uint32), points or segments per strand (uint16), points (3 float32).
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from reconstruction.arrays import Floats, Ints
from reconstruction.files.durable import writing
from reconstruction.files.strands.errors import StrandFileError, radii, require_finite
from reconstruction.geometry.strands import Strands

HEADER = struct.Struct("<4s4I5f88s")
SEGMENTS, POINTS, THICKNESS, TRANSPARENCY, COLOUR = 1, 2, 4, 8, 16
MOST_SEGMENTS = 65535
INFORMATION = b"hairstage: metres, z up, roots first; thickness is twice the radius"


def read_hair(path: Path) -> Strands:
    """Read a `.hair` file, with or without a header; strands without a segment are skipped.

    A thickness of 0 becomes `THINNEST`, a missing one the default radius.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(HEADER.size)
        if head[:4].upper() != b"HAIR" and (found := _headerless(path, head, size)):
            return found
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
    return _strands(xyz, segments, radii(width))


def _headerless(path: Path, head: bytes, size: int) -> Strands | None:
    """The strands of a file without a header, None if its counts do not make up its size."""
    if len(head) < 8:
        return None
    strands, points = struct.unpack_from("<2I", head)
    start = 8 + 2 * strands
    if size != start + 12 * points:
        return None
    raw = path.read_bytes()
    counts = np.frombuffer(raw, "<u2", strands, 8).astype(np.int64)
    if counts.sum() + strands == points:
        counts = counts + 1
    if counts.sum() != points:
        return None
    xyz = np.frombuffer(raw, "<f4", 3 * points, start).reshape(-1, 3)
    require_finite(xyz, range(start, size, 12))
    return _strands(xyz, counts - 1, None)


def _strands(xyz: Floats, segments: Ints, radius: float | Floats | None) -> Strands:
    """Strands of points `(N, 3)`, without those of no segment."""
    keep = np.repeat(segments > 0, np.maximum(segments + 1, 0))
    offsets = np.concatenate([[0], np.cumsum(segments[segments > 0] + 1)]).astype(np.int64)
    if radius is None:
        return Strands(xyz[keep], offsets)
    return Strands(xyz[keep], offsets, radius if isinstance(radius, float) else radius[keep])


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

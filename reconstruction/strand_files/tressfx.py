"""AMD TressFX `.tfx` files, version 4, as input.

A 160-byte little-endian header: version (float32), strands, vertices per strand, then the byte
offsets of vertex positions, strand UVs, vertex UVs, thickness and colour, and 32 reserved words.
Positions are four float32 a vertex: x, y, z and the inverse mass, which is not read.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from reconstruction.strand_files.errors import StrandFileError, strands_of
from reconstruction.strands import Strands

HEADER = struct.Struct("<f7I128s")


def read_tfx(path: Path) -> Strands:
    """Read the strands of a version 4 file, in the file's own frame and unit."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(HEADER.size)
        if len(head) < HEADER.size:
            raise StrandFileError(
                f"{path}: {len(head)} bytes, a .tfx header has {HEADER.size}: truncated"
            )
        version, strands, vertices, start, *_ = HEADER.unpack(head)
        if version != 4.0:
            raise StrandFileError(
                f"{path}: TressFX version {version:.9g}, only version 4 can be read"
            )
        if vertices < 2:
            raise StrandFileError(f"{path}: {vertices} vertices a strand, at least 2 are needed")
        needed = start + 16 * strands * vertices
        if start < HEADER.size or needed > size:
            raise StrandFileError(
                f"{path}: truncated, or its counts are wrong: {strands} strands of {vertices} "
                f"vertices from byte {start} end at byte {needed}, the file has {size}"
            )
        file.seek(start)
        points = np.frombuffer(file.read(16 * strands * vertices), "<f4").reshape(-1, 4)[:, :3]
    return strands_of(path, points, np.arange(strands + 1) * vertices)

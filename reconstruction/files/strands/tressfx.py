"""Reading AMD TressFX `.tfx` files, versions 3 and 4.

Little-endian, the same number of vertices per strand, byte offsets from the start of the file, 0 if
absent.

Version 4, 160 bytes: version (float32), strands, vertices per strand, then the offsets of vertex
positions, strand UVs, vertex UVs, thickness and colour, and 32 reserved words. Positions are four
float32 a vertex: x, y, z and the inverse mass.

Version 3, 296 bytes: version (float32), strands, vertices per strand, followers per strand, whether
both ends are held, 31 reserved words, then the offsets of vertex positions, thickness, strand UVs,
colour, guide indices and vertex UVs, and 32 reserved words. Positions are three float32 a vertex.

Only positions are read; followers are not in the file.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from reconstruction.files.strands.errors import StrandFileError, require_finite
from reconstruction.geometry.strands import Strands

_COUNTS = struct.Struct("<f2I")
_LAYOUTS = {3.0: (296, 144, 12), 4.0: (160, 12, 16)}
"""By version: bytes of the header, where it holds the positions' offset, bytes per vertex."""


def read_tfx(path: Path) -> Strands:
    """Read the strands of a version 3 or 4 file, in the file's own frame and unit."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(max(length for length, _, _ in _LAYOUTS.values()))
        if len(head) < _COUNTS.size:
            raise StrandFileError(f"{len(head)} bytes, a .tfx header has at least 160: truncated")
        version, strands, vertices = _COUNTS.unpack_from(head)
        if version not in _LAYOUTS:
            raise StrandFileError(
                f"byte 0: TressFX version {version:.9g}, only 3 and 4 can be read"
            )
        header, where, stride = _LAYOUTS[version]
        if len(head) < header:
            raise StrandFileError(
                f"{len(head)} bytes, the header of a version {version:g} .tfx has {header}:"
                " truncated"
            )
        if vertices < 2:
            raise StrandFileError(f"byte 8: {vertices} vertices a strand, at least 2 are needed")
        (start,) = struct.unpack_from("<I", head, where)
        needed = start + stride * strands * vertices
        if start < header or needed > size:
            raise StrandFileError(
                f"truncated, or its counts are wrong: {strands} strands of {vertices} "
                f"vertices from byte {start} end at byte {needed}, the file has {size} and its "
                f"header {header}"
            )
        file.seek(start)
        data = np.frombuffer(file.read(stride * strands * vertices), "<f4")
    points = data.reshape(-1, stride // 4)[:, :3]
    require_finite(points, range(start, needed, stride))
    return Strands(points, np.arange(strands + 1) * vertices)

"""Reading `.data` files of Hair Photobooth and USC-HairSalon.

Little-endian, no magic: the number of strands (int32); for each strand the number of its points
(int32), then those points, root first, three float32 each. USC-HairSalon stores a root without hair
as a strand of one point. (graphics.ucsd.edu/~will/download/HairPhotobooth; L. Hu, C. Ma, L. Luo,
H. Li: Single-View Hair Modeling Using a Hairstyle Database, 2015.)
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from reconstruction.files.strands.errors import StrandFileError, require_finite
from reconstruction.geometry.strands import Strands


def read_data(path: Path) -> Strands:
    """Read a `.data` file in its frame and unit; strands of under two points are skipped.

    The counts must match the file size exactly, as the format has no magic.
    """
    raw = path.read_bytes()
    if len(raw) < 4:
        raise StrandFileError(f"{len(raw)} bytes, a .data file has at least 4: truncated")
    words = np.frombuffer(raw[: len(raw) // 4 * 4], "<i4")
    strands = int(words[0])
    if strands < 0 or 4 * (strands + 1) > len(raw):
        raise StrandFileError(
            f"byte 0: {strands} strands need at least {4 * (strands + 1)} bytes, the file "
            f"has {len(raw)}: not a .data file, or truncated"
        )
    counts = np.zeros(strands, np.int64)
    at = 1
    for i in range(strands):
        count = int(words[at]) if at < len(words) else 0
        end = at + 1 + 3 * count
        if count < 0 or 4 * max(end, at + 1) > len(raw):
            raise StrandFileError(
                f"byte {4 * at}: strand {i} of {strands} has {count} points, which end at "
                f"byte {4 * max(end, at + 1)}, the file has {len(raw)}: truncated, or not a .data "
                "file"
            )
        counts[i] = count
        at = end
    if 4 * at != len(raw):
        raise StrandFileError(
            f"byte {4 * at}: the {strands} strands end here, the file has {len(raw)} "
            "bytes: not a .data file, or its counts are wrong"
        )
    first = np.cumsum(np.concatenate([[2], 3 * counts[:-1] + 1])) if strands else counts
    keep = counts >= 2
    offsets = np.concatenate([[0], np.cumsum(counts[keep])])
    place = np.arange(offsets[-1]) - np.repeat(offsets[:-1], counts[keep])
    word = np.repeat(first[keep], counts[keep]) + 3 * place
    points = words.view("<f4")[word[:, None] + np.arange(3)]
    require_finite(points, 4 * word)
    return Strands(points, offsets)

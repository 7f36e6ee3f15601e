"""Writers of files that state how their values are meant, from the formats' specifications."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import tifffile

H, W = 24, 32
LIGHT = np.full((H, W, 3), (0.30, 0.20, 0.10), np.float32)
LIGHT[5:12, 6:15] = (0.02, 0.015, 0.01)
LIGHT[15:20, 20:30] = (0.8, 0.4, 0.2)


def exr(path: Path, image: Any, **header: Any) -> None:
    """One part with `image (h, w, 3)`, or channels by name."""
    channels = image if isinstance(image, dict) else {"RGB": np.ascontiguousarray(image)}
    kind = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.NO_COMPRESSION}
    OpenEXR.File({**kind, **header}, channels).write(str(path))


def exr_parts(path: Path, **parts: Any) -> None:
    """Parts by name, each an image or channels by name."""
    kind = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    OpenEXR.File(
        [
            OpenEXR.Part({"name": n, **kind}, c if isinstance(c, dict) else {"RGB": c})
            for n, c in parts.items()
        ]
    ).write(str(path))


def hdr(path: Path, image: Any, lines: str = "", axes: str = "-Y {h} +X {w}", **how: Any) -> None:
    """Pixels `(h, w, 3)` in the file's order of scanlines, with header `lines`."""
    end, fmt, packed = how.get("end", "\n"), how.get("format", "rgbe"), how.get("packed", True)
    brightest = np.maximum(image.max(axis=-1), 1e-32)
    mantissa, exponent = np.frexp(brightest)
    shares = image * (mantissa * 256 / brightest)[..., None]
    rgbe = np.concatenate([shares, exponent[..., None] + 128], axis=-1).astype(np.uint8)
    head = f"#?RADIANCE{end}{lines}FORMAT=32-bit_rle_{fmt}{end}{end}".encode()
    h, w = rgbe.shape[:2]
    data = b""
    for line in rgbe if packed else ():
        data += bytes([2, 2, w >> 8, w & 255])
        data += b"".join(bytes([w]) + line[:, k].tobytes() for k in range(4))
    path.write_bytes(head + (axes.format(h=h, w=w) + "\n").encode() + (data or rgbe.tobytes()))


def png(path: Path, values: Any, chunks: Sequence[tuple[bytes, bytes]] = ()) -> None:
    """Integers `(h, w)` or `(h, w, c)`: grey, grey and alpha, RGB or RGBA."""
    values = np.asarray(values)
    values = values[..., None] if values.ndim == 2 else values
    kind = {1: 0, 2: 4, 3: 2, 4: 6}[values.shape[-1]]
    head = struct.pack(
        ">IIBBBBB", values.shape[1], values.shape[0], 8 * values.itemsize, kind, 0, 0, 0
    )
    rows = b"".join(b"\0" + r.astype(values.dtype.newbyteorder(">")).tobytes() for r in values)
    parts = [(b"IHDR", head), *chunks, (b"IDAT", zlib.compress(rows)), (b"IEND", b"")]
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + b"".join(
            struct.pack(">I", len(d)) + n + d + struct.pack(">I", zlib.crc32(n + d))
            for n, d in parts
        )
    )


def tiff(path: Path, values: Any, **how: Any) -> None:
    tifffile.imwrite(path, values, metadata=None, **{"photometric": "rgb", **how})


def mosaic(image: Any) -> Any:
    """RGGB of `(h, w, 3)`."""
    out = np.empty(image.shape[:2])
    for y, x, colour in ((0, 0, 0), (0, 1, 1), (1, 0, 1), (1, 1, 2)):
        out[y::2, x::2] = image[y::2, x::2, colour]
    return out


def dng(path: Path, counts: Any, white: Any = 4095, **tags: Any) -> None:
    """RGGB `counts (h, w)`; `tags`: black, repeat, delta_h, delta_v, opcodes, and `more` tags of
    tifffile's."""
    black = tags.get("black", (256,))
    white = tuple(np.atleast_1d(white))
    whole = [
        (50706, 1, 4, b"\1\4\0\0", True), (50707, 1, 4, b"\1\1\0\0", True),
        (50708, 2, None, "Made-up", True), (271, 2, None, "Made-up", True),
        (272, 2, None, "Made-up", True), (33421, 3, 2, (2, 2), True),
        (33422, 1, 4, b"\0\1\1\2", True), (50710, 1, 3, b"\0\1\2", True),
        (50711, 3, 1, 1, True), (50713, 3, 2, tags.get("repeat", (1, 1)), True),
        (50714, 4, len(black), black if len(black) > 1 else black[0], True),
        (50717, 4, len(white), white if len(white) > 1 else white[0], True),
        (50721, 10, 9, sum(((int(i % 4 == 0), 1) for i in range(9)), ()), True),
        (50778, 3, 1, 21, True),
    ]  # fmt: skip
    for number, name in ((50715, "delta_h"), (50716, "delta_v")):
        if name in tags:
            pairs = sum(((int(2 * v), 2) for v in tags[name]), ())
            whole.append((number, 10, len(tags[name]), pairs, True))
    whole += tags.get("more", ())
    if "opcodes" in tags:
        whole.append((51009, 7, len(tags["opcodes"]), tags["opcodes"], True))
    tifffile.imwrite(
        path, np.asarray(np.rint(counts), np.uint16), photometric=32803, planarconfig=1,
        extratags=whole, metadata=None, rowsperstrip=len(counts), software=False,
    )  # fmt: skip

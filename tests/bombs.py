"""Small files that unpack to large pictures and meshes, and what memory reading them takes."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any


def peak_mb(work: Callable[[], Any]) -> float:
    """By how many MB this process grew at most while `work` was done."""
    Path("/proc/self/clear_refs").write_text("5")  # forget the peak so far
    before = _resident_mb("VmRSS")
    work()
    return _resident_mb("VmHWM") - before


def _resident_mb(field: str) -> float:
    status = Path("/proc/self/status").read_text().splitlines()
    line = next(line for line in status if line.startswith(field))
    return int(line.split()[1]) / 1024


def exr(width: int, height: int, *, claimed: tuple[int, int] | None = None) -> bytes:
    """A ZIP-compressed OpenEXR file of zeros; `claimed` is the size in its header, where it has
    another."""
    lines = 16
    chunk = zlib.compress(bytes(width * lines * 12), 9)
    w, h = claimed or (width, height)
    box = struct.pack("<4i", 0, 0, w - 1, h - 1)
    channels = b"".join(n + b"\0" + struct.pack("<4i", 2, 0, 1, 1) for n in (b"B", b"G", b"R"))
    header = b"\x76\x2f\x31\x01\x02\0\0\0"
    for name, kind, value in (
        ("channels", "chlist", channels + b"\0"),
        ("compression", "compression", b"\3"),
        ("dataWindow", "box2i", box),
        ("displayWindow", "box2i", box),
        ("lineOrder", "lineOrder", b"\0"),
        ("pixelAspectRatio", "float", struct.pack("<f", 1)),
        ("screenWindowCenter", "v2f", bytes(8)),
        ("screenWindowWidth", "float", struct.pack("<f", 1)),
    ):
        header += f"{name}\0{kind}\0".encode() + struct.pack("<i", len(value)) + value
    header += b"\0"
    count = -(-h // lines)
    there = min(count, height // lines)
    begin, size = len(header) + 8 * count, 8 + len(chunk)
    places = b"".join(struct.pack("<Q", begin + size * min(i, there - 1)) for i in range(count))
    chunks = b"".join(struct.pack("<2i", i * lines, len(chunk)) + chunk for i in range(there))
    return header + places + chunks


def radiance(width: int, height: int) -> bytes:
    """A run-length encoded Radiance file of one grey."""
    runs = bytes([255, 128]) * (width // 127) + bytes([128 + width % 127, 128])
    line = bytes([2, 2, width >> 8, width & 255]) + runs * 4
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y %d +X %d\n" % (height, width)
    return head + line * height


def png(width: int, height: int, *, more: bytes = b"", data: bytes | None = None) -> bytes:
    """A grey PNG, black, with `more` chunks before its `data`."""
    size = struct.pack(">2I5B", width, height, 8, 0, 0, 0, 0)
    data = zlib.compress(bytes((width + 1) * height)) if data is None else data
    parts = chunk(b"IHDR", size) + more + chunk(b"IDAT", data) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + parts


def chunk(kind: bytes, data: bytes) -> bytes:
    """A chunk of a PNG."""
    check = zlib.crc32(kind + data)
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", check)


def obj(faces: int) -> bytes:
    """A mesh of so many triangles on three vertices."""
    return b"v 0 0 0\nv 0 1 0\nv 1 0 0\n" + b"f 1 2 3\n" * faces


def polygon(corners: int) -> bytes:
    """A mesh of one face."""
    return b"v 0 0 0\nv 0 1 0\nv 1 0 0\nf " + b"1 2 3 " * (corners // 3) + b"\n"

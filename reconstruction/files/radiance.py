"""Radiance `.hdr` images ("Radiance File Formats", Ward 1994)."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Array, Floats
from reconstruction.containment import plain_file
from reconstruction.files.colour import to_rec709, xyz_to_rec709

_HEADER = 1 << 16
"""Bytes in which the header ends."""
_SIZE = re.compile(rb"([-+])([XY])[ \t]+(\d{1,9})[ \t]+([-+])([XY])[ \t]+(\d{1,9})[ \t]*\r?\n")


@dataclass
class _Header:
    """`size` of the scanlines' order: lines, pixels; `axes` as in the file, "-Y+X"."""

    axes: str = ""
    size: tuple[int, int] = (0, 0)
    begin: int = 0
    scale: Array = field(default_factory=lambda: np.ones(3))
    matrix: Array | None = None


def hdr_size(path: Path) -> tuple[int, int]:
    """Width and height. Raises `ValueError`."""
    with plain_file(path).open("rb") as file:
        header = _header(path, file.read(_HEADER))
    return header.size if header.axes[1] == "X" else header.size[::-1]


def read_hdr(path: Path) -> Floats:
    """Linear Rec. 709 light `(h, w, 3)`, upright, with exposures and corrections divided out.

    Raises `ValueError` naming the file and the variable that is not read.
    """
    data = plain_file(path).read_bytes()
    header = _header(path, data[:_HEADER])
    lines, count = header.size
    pixels = data[header.begin :]
    packed = 8 <= count < 1 << 15 and pixels[:2] == b"\2\2" and pixels[2:3] < b"\x80"
    image = (_packed if packed else _flat)(pixels, lines, count)
    if image is None:
        raise ValueError(
            f"{path}: cannot be read (truncated, damaged or of the old packing; {lines} lines of "
            f"{count} pixels): copy it again, or write it anew"
        )
    image = np.asarray(image / header.scale, np.float32)
    if header.matrix is not None:
        image = np.asarray(image @ header.matrix.T, np.float32)
    if header.axes[1] == "X":
        image = image.swapaxes(0, 1)
    image = image[:: -1 if "+Y" in header.axes else 1, :: -1 if "-X" in header.axes else 1]
    return np.ascontiguousarray(image, np.float32)


def _header(path: Path, data: bytes) -> _Header:
    match = re.search(rb"\r?\n\r?\n", data)
    found = _SIZE.match(data, match.end()) if match and data.startswith(b"#?") else None
    if match is None or found is None:
        raise ValueError(f"{path}: cannot be read as a Radiance .hdr image: it has no size")
    first, one, rows, second, other, columns = (x.decode() for x in found.groups())
    if {one, other} != {"X", "Y"}:
        raise ValueError(f"{path}: {found[0].decode().strip()!r}: expected X and Y")
    if b"\nFORMAT=" not in data[: match.start()]:
        raise ValueError(f"{path}: no FORMAT: write FORMAT=32-bit_rle_rgbe")
    out = _Header(first + one + second + other, (int(rows), int(columns)), found.end())
    for line in data[: match.start()].decode("latin-1").split("\n")[1:]:
        name, _, text = line.rstrip("\r").partition("=")
        if name == "FORMAT":
            if text.strip() not in ("32-bit_rle_rgbe", "32-bit_rle_xyze"):
                raise ValueError(f"{path}: FORMAT {text.strip()!r}: write 32-bit_rle_rgbe")
            if text.strip().endswith("xyze"):
                out.matrix = xyz_to_rec709()
            continue
        expected = {"EXPOSURE": 1, "GAMMA": 1, "COLORCORR": 3, "PRIMARIES": 8}.get(name)
        if expected is None:
            continue
        try:
            numbers = np.array([float(x) for x in text.split()])
        except ValueError:
            numbers = np.empty(0)
        if len(numbers) != expected or not np.isfinite(numbers).all() or (numbers <= 0).any():
            raise ValueError(f"{path}: {line.strip()!r}: expected positive numbers, {expected}")
        if name == "GAMMA" and numbers[0] != 1:
            raise ValueError(f"{path}: {line.strip()!r}: write linear light, GAMMA=1")
        if name == "PRIMARIES" and out.matrix is None:
            try:
                out.matrix = to_rec709(numbers)
            except ValueError as error:
                raise ValueError(f"{path}: PRIMARIES: {error}") from error
        if name in ("EXPOSURE", "COLORCORR"):
            out.scale = out.scale * numbers
    return out


def _packed(data: bytes, lines: int, count: int) -> Floats | None:
    """Lines whose components are packed one by one; None for damage."""
    start, at, out = bytes([2, 2, count >> 8, count & 255]), 0, bytearray()
    if len(data) < lines * (4 + 8 * -(-count // 127)):
        return None
    for number in range(4 * lines):
        if number % 4 == 0:
            if data[at : at + 4] != start:
                return None
            at += 4
        end = len(out) + count
        while len(out) < end:
            n = data[at] if at < len(data) else 0
            if n == 0:
                return None
            out += data[at + 1 : at + 2] * (n - 128) if n > 128 else data[at + 1 : at + 1 + n]
            at += 2 if n > 128 else 1 + n
        if len(out) != end:
            return None
    return _floats(np.frombuffer(out, np.uint8).reshape(lines, 4, count).transpose(0, 2, 1))


def _flat(data: bytes, lines: int, count: int) -> Floats | None:
    """Pixels that are not packed; None for damage and the old packing, in which (1, 1, 1, n)
    repeats a pixel."""
    if len(data) != 4 * lines * count:
        return None
    rgbe = np.frombuffer(data, np.uint8).reshape(lines, count, 4)
    if (rgbe[..., :3] == 1).all(axis=-1).any():
        return None
    return _floats(rgbe)


def _floats(rgbe: NDArray[np.uint8]) -> Floats:
    scale = np.where(rgbe[..., 3:] > 0, np.ldexp(1.0, rgbe[..., 3:].astype(int) - 136), 0)
    return np.asarray(rgbe[..., :3] * scale, np.float32)

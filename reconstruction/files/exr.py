"""OpenEXR files: `(H, W, 3)` images and header attributes."""

from __future__ import annotations

import mmap
import struct
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np
import OpenEXR

from reconstruction.arrays import AnyFloats, Floats
from reconstruction.files.durable import PAGE, writing

Attributes = Mapping[str, float | str]


class OtherChannels(ValueError):
    """A valid file without the channels R, G and B."""


def read_exr(path: str | Path) -> tuple[Floats, dict[str, float | str]]:
    """Read R, G and B `(H, W, 3)`, or Y as grey, and the header attributes of `write_exr`.

    Raises `ValueError` naming a file that is missing, broken or has other channels.
    """
    try:
        with suppress(Exception):  # other files are handled below
            file = OpenEXR.File(str(path))  # faster; fails for mixed channel types
            found = file.channels()
            pixels = found["RGBA" if "RGBA" in found else "RGB"].pixels
            return np.ascontiguousarray(pixels[..., :3], np.float32), _own(file)
        file = OpenEXR.File(str(path), separate_channels=True)
        channels = {name: channel.pixels for name, channel in file.channels().items()}
    except Exception as error:  # the binding raises RuntimeError and MemoryError
        raise ValueError(f"{path}: cannot be read as OpenEXR ({error})") from error
    colours = "YYY" if set(channels) - {"A"} == {"Y"} else "RGB"
    if not set(colours) <= set(channels) or len({channels[c].shape for c in colours}) > 1:
        there = ", ".join(sorted(channels))
        raise OtherChannels(
            f"{path}: expected channels R, G and B of one size, got {there}: write the "
            "image as RGB "
            "without layers"
        )
    return np.stack([channels[c] for c in colours], axis=-1, dtype=np.float32), _own(file)


def _own(file: OpenEXR.File) -> dict[str, float | str]:
    """Header attributes that are numbers or text."""
    return {k: v for k, v in file.header().items() if isinstance(v, float | str)}


def write_exr(
    path: str | Path,
    image: AnyFloats,
    attributes: Attributes | None = None,
    *,
    compress: bool = True,
) -> None:
    """Write `image (H, W, 3)` losslessly as float32 RGB: temporary name, fsync, rename.

    Raises `OSError`; an incomplete file is removed.
    """
    path = Path(path)
    if image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(f"{path}: expected an image of shape (H, W, 3), got {image.shape}")
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION if compress else OpenEXR.NO_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        **(attributes or {}),
    }
    pixels = np.ascontiguousarray(image, dtype=np.float32)
    try:
        with writing(path) as temporary:
            OpenEXR.File(header, {"RGB": pixels}).write(str(temporary))
    except RuntimeError as error:  # the binding's own error has no errno
        raise OSError(f"{path}: {error}") from error


class UncompressedExr:
    """A reusable in-memory uncompressed RGB float32 file of a fixed size.

    Several times faster than the general writer, without holding the GIL; the bytes can be hashed
    and written from memory. The layout is "OpenEXR File Layout" (openexr.com): magic, version,
    attributes, offset table, then for each line its y, byte count and planes B, G, R. Header
    padding makes the file end on a page.
    """

    def __init__(self, height: int, width: int) -> None:
        line = np.dtype([("y", "<i4"), ("bytes", "<i4"), ("bgr", "<f4", (3, width))])
        self.shape = (height, width, 3)
        self._header_room = -(height * line.itemsize) % PAGE
        while self._header_room < 8 * height + HEADER_ROOM:
            self._header_room += PAGE
        self._memory = mmap.mmap(-1, self._header_room + height * line.itemsize)
        lines = np.ndarray((height,), line, self._memory, self._header_room)
        lines["y"] = np.arange(height)
        lines["bytes"] = 12 * width
        self._pixels = lines["bgr"]
        self._attributes: Attributes | None = None  # of the current header
        self._offsets = self._header_room + line.itemsize * np.arange(height, dtype="<u8")

    def fill(self, image: AnyFloats, attributes: Attributes) -> memoryview:
        """The file with `image (H, W, 3)`, valid until the next call.

        Raises `ValueError` if the attributes exceed the header.
        """
        if attributes != self._attributes:
            head = _header(self.shape[0], self.shape[1], attributes) + self._offsets.tobytes()
            if len(head) > self._header_room:
                raise ValueError(f"the attributes exceed {HEADER_ROOM} bytes: {attributes}")
            self._memory[: self._header_room] = head.ljust(self._header_room, b"\0")
            self._attributes = dict(attributes)
        self._pixels[:] = image.transpose(0, 2, 1)[:, ::-1]
        return memoryview(self._memory)


HEADER_ROOM = 1024
"""Bytes reserved for attributes; the fixed ones take under 400."""


def _header(height: int, width: int, attributes: Attributes) -> bytes:
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    channel = struct.pack("<iiii", 2, 0, 1, 1)  # float, not perceptual, every pixel
    fixed = {
        "channels": ("chlist", b"".join(n + b"\0" + channel for n in (b"B", b"G", b"R")) + b"\0"),
        "compression": ("compression", b"\0"),
        "dataWindow": ("box2i", window),
        "displayWindow": ("box2i", window),
        "lineOrder": ("lineOrder", b"\0"),
        "pixelAspectRatio": ("float", struct.pack("<f", 1.0)),
        "screenWindowCenter": ("v2f", struct.pack("<2f", 0.0, 0.0)),
        "screenWindowWidth": ("float", struct.pack("<f", 1.0)),
        "type": ("string", b"scanlineimage"),
    }
    own = {
        k: ("string", v.encode()) if isinstance(v, str) else ("float", struct.pack("<f", v))
        for k, v in attributes.items()
    }
    parts = [b"\x76\x2f\x31\x01\x02\0\0\0"]
    for name, (kind, value) in {**own, **fixed}.items():
        if not 1 <= len(name.encode()) <= 31:  # longer names need a flag that old readers refuse
            raise ValueError(f"an attribute's name has 1 to 31 bytes, got {name!r}")
        parts.append(f"{name}\0{kind}\0".encode() + struct.pack("<i", len(value)) + value)
    return b"".join(parts) + b"\0"

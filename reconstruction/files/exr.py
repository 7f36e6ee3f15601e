"""OpenEXR files: `(H, W, 3)` images and header attributes."""

from __future__ import annotations

import mmap
import struct
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR

from reconstruction.arrays import AnyFloats, Array, Floats
from reconstruction.files.colour import REC709, to_rec709
from reconstruction.files.durable import PAGE, writing

Attributes = Mapping[str, float | str]


class OtherChannels(ValueError):
    """A valid file without one image of R, G and B, or with attributes that are not read."""


MOST_PIXELS, MOST_SIDE = 1 << 28, 1 << 16
"""Pixels of a display window, and of its longer side; the largest sensors have 151 million."""


def read_exr(path: str | Path) -> tuple[Floats, dict[str, float | str]]:
    """Read the display window `(H, W, 3)` as linear Rec. 709, black outside the data window, and
    the numbers and texts of the header.

    The image is the only part with R, G and B, else the only layer with them or with Y. Raises
    `ValueError` naming a file that is missing or broken, has other channels, or an attribute that
    is not read.
    """
    number, names, header = chosen_image(path)
    _check(path, header)
    image = _pixels(path, number, names)
    image = _in_display_window(path, np.asarray(image, np.float32), header)
    matrix = _to_rec709(path, header)
    if matrix is not None:
        image = image @ matrix.T.astype(np.float32)
    own = {k: v for k, v in header.items() if isinstance(v, float | str)}
    return np.ascontiguousarray(image), own


def chosen_image(path: str | Path) -> tuple[int, list[str], dict[str, Any]]:
    """The number of the part that `read_exr` reads, the names of its channels (R, G, B; or Y), and
    its header. Raises `ValueError`."""
    try:
        parts = OpenEXR.File(str(path), header_only=True).parts
        headers = [dict(part.header) for part in parts]
    except Exception as error:  # the binding raises RuntimeError and MemoryError
        raise _broken(path, error) from error
    plain: list[tuple[int, list[str]]] = []
    layers: list[tuple[int, list[str]]] = []
    for number, header in enumerate(headers):
        there = {c.name for c in header["channels"]}
        for layer in sorted({n[: n.rfind(".") + 1] for n in there}):
            own = {n[len(layer) :] for n in there if n.startswith(layer)}
            if own >= set("RGB"):
                (layers if layer else plain).append((number, [layer + c for c in "RGB"]))
            elif "Y" in own and not own & {"X", "Z", "RY", "BY"}:  # no vectors, no chroma
                layers.append((number, [layer + "Y"]))
    found = plain or layers
    if len(found) == 1:
        number, names = found[0]
        return number, names, headers[number]
    listed = "; ".join(
        f"part {header.get('name', number)!r}: " * (len(headers) > 1)
        + ", ".join(sorted(c.name for c in header["channels"]))
        for number, header in enumerate(headers)
    )
    raise OtherChannels(
        f"{path}: expected channels R, G and B of one image, got {listed}: "
        "write the image as RGB without layers, in one part"
    )


def window_size(window: Any) -> tuple[int, int]:
    """Width and height of a data or display window."""
    width, height = (int(b) - int(a) + 1 for a, b in zip(*window, strict=True))
    return width, height


def _broken(path: str | Path, error: object) -> ValueError:
    return ValueError(f"{path}: cannot be read as OpenEXR ({error})")


def _check(path: str | Path, header: Mapping[str, Any]) -> None:
    """Raise `OtherChannels` for an attribute that changes pixels and is not read."""
    for name in ("chromaticities", "whiteLuminance", "adoptedNeutral", "pixelAspectRatio"):
        if isinstance(header.get(name), OpenEXR.OpaqueAttribute):
            raise OtherChannels(f"{path}: {name} has a type that is not its own: remove it")
    width, height = window_size(header["displayWindow"])
    white, neutral = header.get("whiteLuminance"), header.get("adoptedNeutral")
    space = str(header.get("colorInteropID", "unknown"))
    wrong = ""
    if "deep" in str(header.get("type", "")):
        wrong = f"type {str(header['type']).split('.')[-1]}: flatten the deep samples"
    elif "CUBE" in str(header.get("envmap", "")):
        wrong = "envmap cube: write a lat-long map"
    elif width * height > MOST_PIXELS or max(width, height) > MOST_SIDE:
        wrong = (
            f"displayWindow has {width}x{height} pixels: at most {MOST_PIXELS:,} are read, and "
            f"{MOST_SIDE:,} in a line"
        )
    elif white is not None:
        wrong = f"whiteLuminance {white:g} cd/m²: write radiance, without this attribute"
    elif neutral is not None and not np.allclose(neutral, _chromaticities(header)[6:], atol=1e-3):
        xy = " ".join(f"{x:g}" for x in neutral)
        wrong = f"adoptedNeutral {xy} is not white: balance the image and remove the attribute"
    elif not space.startswith(("lin_rec709", "unknown")) and (
        "chromaticities" not in header or not space.startswith("lin_")
    ):
        wrong = f"colorInteropID {space!r}: write linear Rec. 709, or lin_… with chromaticities"
    if wrong:
        raise OtherChannels(f"{path}: {wrong}")


def _chromaticities(header: Mapping[str, Any]) -> tuple[float, ...]:
    return tuple(map(float, header.get("chromaticities", REC709)))


def _to_rec709(path: str | Path, header: Mapping[str, Any]) -> Array | None:
    try:
        return to_rec709(_chromaticities(header))
    except ValueError as error:
        raise OtherChannels(f"{path}: {error}") from error


def _in_display_window(path: str | Path, image: Floats, header: Mapping[str, Any]) -> Floats:
    """`image` of the data window at its place in the display window."""
    data, display = (np.array(header[name], int) for name in ("dataWindow", "displayWindow"))
    if (data == display).all():
        return image
    low, high = np.maximum(data[0], display[0]), np.minimum(data[1], display[1])
    if (low > high).any():
        raise OtherChannels(
            f"{path}: dataWindow {data.tolist()} lies outside displayWindow {display.tolist()}: "
            "write the image inside it"
        )
    width, height = window_size(display)
    out = np.zeros((height, width, 3), np.float32)
    to, of = low - display[0], low - data[0]
    w, h = high - low + 1
    out[to[1] : to[1] + h, to[0] : to[0] + w] = image[of[1] : of[1] + h, of[0] : of[0] + w]
    return out


def _pixels(path: str | Path, number: int, names: list[str]) -> AnyFloats:
    """R, G and B `(h, w, 3)` of the data window of a part."""
    if names == ["R", "G", "B"]:
        with suppress(Exception):  # faster; fails for mixed channel types
            found = OpenEXR.File(str(path)).channels(number)
            return np.asarray(found["RGBA" if "RGBA" in found else "RGB"].pixels[..., :3])
    try:
        found = OpenEXR.File(str(path), separate_channels=True).channels(number)
        pixels = [found[name].pixels for name in names]
        steps = [(found[name].xSampling, found[name].ySampling) for name in names]
    except Exception as error:  # the binding raises RuntimeError and MemoryError
        raise _broken(path, error) from error
    if set(steps) != {(1, 1)}:
        raise OtherChannels(f"{path}: channels sampled {steps}: write R, G and B of every pixel")
    return np.stack(pixels * (3 // len(pixels)), axis=-1, dtype=np.float32)


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

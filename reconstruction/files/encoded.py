"""Encoded images: where their pixels lie, their values, and the colour they state.

OpenImageIO reads all but EXR, Radiance, RAW (rawpy) and AVIF (OpenCV).
"""

from __future__ import annotations

import struct
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenImageIO as oiio
import rawpy
from numpy.typing import NDArray

from reconstruction.files.colour import Colour, of_code_points, of_icc, to_rec709
from reconstruction.files.exr import OtherChannels, chosen_image, window_size
from reconstruction.files.masks import AS_STORED, exif_orientation, png_chunks
from reconstruction.files.radiance import hdr_size, read_hdr
from reconstruction.files.tiff_tags import dng_crop, tags_of, tiff_values

Size = tuple[int, int]
"""Width and height."""

RAW = {".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".rw2", ".orf", ".pef", ".srw"}
FORMATS = {".exr", ".hdr", ".png", ".tif", ".tiff", ".jpg", ".jpeg", ".avif", ".pgm", ".ppm"} | RAW
_AVIF_HEAD = 1 << 16  # bytes with an AVIF's boxes


class PictureError(ValueError):
    """An image that cannot be used; the message names the file and what to do."""


@dataclass(frozen=True)
class Placement:
    """Where a file's pixels lie: `size` as stored, EXIF `orientation` 1 to 8, and `aspect`, a
    pixel's width by its height. `crop`: left, top, width and height that RAW recommends to show
    (DNG's DefaultCropOrigin and DefaultCropSize), which some programs develop and some do not."""

    size: Size
    orientation: int = 1
    aspect: float = 1.0
    crop: tuple[int, int, int, int] | None = None

    @property
    def turned(self) -> Size:
        """The size after the orientation."""
        return self.size[::-1] if self.orientation > 4 else self.size

    def of_camera(self, size: Size) -> Placement:
        """That of the crop where only the crop has a camera's `size`, upright or turned."""
        if self.crop is None or size in (self.size, self.turned):
            return self
        inner = replace(self, size=self.crop[2:])
        return inner if size in (inner.size, inner.turned) else self


def placement(path: Path) -> Placement:
    """The placement from the header. Raises `PictureError`."""
    suffix = path.suffix.lower()
    try:
        if suffix == ".exr":
            header = chosen_image(path)[2]
            return Placement(window_size(header["displayWindow"]), 1, header["pixelAspectRatio"])
        if suffix == ".hdr":
            return Placement(hdr_size(path))
        if suffix in RAW:
            with rawpy.imread(str(path)) as raw:
                return _raw_placement(path, raw.sizes)
    except OtherChannels as error:
        raise PictureError(str(error)) from error
    except Exception as error:  # the bindings raise various types
        raise PictureError(broken(path, error)) from error
    if suffix == ".avif":
        height, width = _avif(path).shape[:2]
        return Placement((width, height), _avif_orientation(path))
    spec = opened(path).spec()
    turn = int(spec.get_int_attribute("Orientation", 1))
    if suffix == ".png":
        turn = exif_orientation(png_chunks(path.read_bytes()).get(b"eXIf", b""))
    aspect = float(spec.get_float_attribute("PixelAspectRatio", 1.0))
    return Placement((int(spec.width), int(spec.height)), turn, aspect if aspect > 0 else 1.0)


def _raw_placement(path: Path, sizes: Any) -> Placement:
    """From rawpy's `ImageSizes`, whose margins are those of the whole sensor."""
    width, height = int(sizes.width), int(sizes.height)
    left, top = sizes.crop_left_margin - sizes.left_margin, sizes.crop_top_margin - sizes.top_margin
    crop = left, top, sizes.crop_width, sizes.crop_height
    if path.suffix.lower() == ".dng":
        with suppress(Exception):  # damage is reported with the pixels
            crop = dng_crop(path) or crop  # LibRaw's begins at even numbers
    x, y, w, h = (int(v) for v in crop)
    there = min(x, y) >= 0 and min(w, h) > 0 and x + w <= width and y + h <= height
    aspect = sizes.pixel_aspect if sizes.pixel_aspect > 0 else 1.0
    turn = {3: 3, 5: 8, 6: 6}.get(sizes.flip, 1)
    return Placement((width, height), turn, float(aspect), (x, y, w, h) if there else None)


def stored_values(path: Path) -> tuple[NDArray[Any], float | None, Colour]:
    """The values `(H, W, C)` of a file that is no EXR or RAW, their white if it is not that of the
    type, and their colour."""
    suffix, white = path.suffix.lower(), None
    try:
        if suffix == ".hdr":
            return read_hdr(path), None, Colour("linear")
        if suffix == ".avif":
            return _avif(path), _avif_white(path), _avif_colour(path)
        source = opened(path)
        values = source.read_image(oiio.UNKNOWN)
        if values is None or source.geterror(False):
            raise PictureError(broken(path, source.geterror()))
        values, colour = np.asarray(values), Colour()
        profile = source.spec().getattribute("ICCProfile")
        if suffix == ".png":
            values, white, colour = _png(path, values)
        elif suffix in (".tif", ".tiff"):
            values, white, colour = tiff_values(tags_of(path), values)
        if profile is not None and not (suffix == ".png" and colour.curve is not None):
            colour = of_icc(bytes(profile))
        return values, white, colour
    except PictureError:
        raise
    except ValueError as error:
        text = str(error)
        raise PictureError(text if text.startswith(str(path)) else f"{path}: {text}") from error
    except Exception as error:  # of wrong headers
        raise PictureError(broken(path, error)) from error


def _png(path: Path, values: NDArray[Any]) -> tuple[NDArray[Any], float | None, Colour]:
    """PNG's own colour (cICP, else sRGB, else gAMA and cHRM; curve None where an ICC profile is
    next) and bits (sBIT)."""
    chunks = png_chunks(path.read_bytes())
    bits, brightest = min(chunks.get(b"sBIT", b"\x10")), int(values.max(initial=0))
    if values.dtype == np.uint16 and 0 < bits < 16 and brightest >> bits == 0:
        kept = values >> (16 - bits)  # PNG scales samples to all 16 bits
        whole = np.rint(kept * (65535 / (2**bits - 1)))
        if not ((values == whole) | (values == kept << (16 - bits))).all():
            raise ValueError(
                f"sBIT {bits}, but values up to {brightest} are not scaled to 16 bits: set "
                f"sensor.white = {2**bits - 1}"
            )
    if b"cICP" in chunks:
        primaries, transfer, *_ = chunks[b"cICP"]
        return values, None, of_code_points(primaries, transfer)
    if b"iCCP" in chunks:
        return values, None, Colour()
    if b"sRGB" in chunks:
        return values, None, Colour("srgb")
    gamma = struct.unpack(">I", chunks[b"gAMA"])[0] / 1e5 if b"gAMA" in chunks else None
    if gamma is not None and not 0.1 < gamma < 10:
        raise ValueError(f"gAMA {gamma:g}: expected 0.45455 or 1")
    matrix = None
    if b"cHRM" in chunks:
        white_red_green_blue = np.array(struct.unpack(">8I", chunks[b"cHRM"])) / 1e5
        matrix = to_rec709(np.roll(white_red_green_blue, -2))
    return values, None, Colour(None if gamma is None else 1 / gamma, matrix)


def _avif(path: Path) -> NDArray[Any]:
    """Integer values `(H, W, 3)`; OpenImageIO's wheels do not read AVIF."""
    how = AS_STORED | cv2.IMREAD_COLOR_RGB | cv2.IMREAD_ANYDEPTH
    values = cv2.imread(str(path), how)
    if values is None:
        raise PictureError(broken(path, "OpenCV cannot read it"))
    return np.asarray(values)


def _avif_white(path: Path) -> float:
    """Largest value, from the `av1C` box ("AV1 Codec ISO Media File Format", 2.3.3)."""
    head = path.read_bytes()[:_AVIF_HEAD]
    at = head.find(b"av1C")
    flags = head[at + 6] if 0 <= at < len(head) - 6 else 0
    return float(2 ** (8 + 2 * (flags >> 6 & 1) + 2 * (flags >> 5 & 1)) - 1)


def _avif_orientation(path: Path) -> int:
    """EXIF orientation, from the boxes `irot` and `imir` (ISO/IEC 23008-12, 6.5)."""
    head = path.read_bytes()[:_AVIF_HEAD]
    turn, mirror = head.find(b"\x09irot"), head.find(b"\x09imir")
    angle = head[turn + 5] & 3 if turn >= 0 else 0
    if mirror < 0:
        return (1, 8, 3, 6)[angle]
    across = head[mirror + 5] & 1
    return ((4, 2), (5, 7), (2, 4), (7, 5))[angle][across]


def _avif_colour(path: Path) -> Colour:
    """The colour in the box `colr`; sRGB curve without one."""
    head = path.read_bytes()[:_AVIF_HEAD]
    at = head.find(b"colr")
    kind = head[at + 4 : at + 8] if at >= 4 else b""
    colour = Colour()
    if kind == b"nclx":
        colour = of_code_points(*struct.unpack_from(">2H", head, at + 8))
    elif kind in (b"prof", b"rICC"):
        colour = of_icc(head[at + 8 : at - 4 + struct.unpack_from(">I", head, at - 4)[0]])
    return colour if colour.curve is not None else replace(colour, curve="srgb")


def opened(path: Path) -> Any:
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)  # colours are not multiplied by alpha
    source = oiio.ImageInput.open(str(path), config)
    if source is None:
        raise PictureError(broken(path, oiio.geterror()))
    return source


def turned(values: Any, orientation: int) -> Any:
    """Pixels `(H, W, …)` turned upright (TIFF 6.0, Orientation)."""
    if orientation > 4:
        values = values.swapaxes(0, 1)
    down, across = orientation in (3, 4, 7, 8), orientation in (2, 3, 6, 7)
    return np.ascontiguousarray(values[:: -1 if down else 1, :: -1 if across else 1])


def broken(path: Path, error: object) -> str:
    text = " ".join(str(error).split()) or "truncated or damaged"
    return f"{path}: cannot be read ({text}): copy it again, or remove it (a frame may be missing)"

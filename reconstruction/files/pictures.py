"""Images of cameras as linear light: EXR, PNG, TIFF, JPEG, AVIF and RAW.

OpenImageIO reads all but RAW (rawpy), AVIF (OpenCV) and EXR. The size is checked before pixels are
read, as a header may claim more than memory.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
import OpenEXR
import OpenImageIO as oiio
import rawpy
from numpy.typing import NDArray
from pydantic import Field

from reconstruction.arrays import Bools, Floats
from reconstruction.files.exr import OtherChannels, read_exr
from reconstruction.files.masks import AS_STORED
from reconstruction.options import options

Positive = Annotated[float, Field(gt=0)]
Size = tuple[int, int]
"""Width and height."""

RAW = {".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".rw2", ".orf", ".pef", ".srw"}
FORMATS = {".exr", ".png", ".tif", ".tiff", ".jpg", ".jpeg", ".avif"} | RAW
MOSAICS = {
    "RGGB": cv2.COLOR_BayerRGGB2RGB_EA,
    "BGGR": cv2.COLOR_BayerBGGR2RGB_EA,
    "GRBG": cv2.COLOR_BayerGRBG2RGB_EA,
    "GBRG": cv2.COLOR_BayerGBRG2RGB_EA,
}
LOSSY = {".jpg", ".jpeg"}
_AVIF_HEAD = 1 << 16  # bytes with an AVIF's boxes
FULL = 0.99
"""Share of the range from black to white at which an integer channel counts as saturated: sensors
are nonlinear near the end."""


class PictureError(ValueError):
    """An image that cannot be used; the message names the file and what to do."""


@options
class Sensor:
    """Conversion of image values to light.

    `response`: "linear", "srgb", or the exponent γ of value = light^(1/γ); None: "srgb" for 8 bits,
    JPEG and AVIF, else "linear". `black` and `white` in the file's values: no light, and a full
    channel; None: those of a RAW file, else 0 and the largest of the type (1 for floats, which
    saturate only with `white` or the EXR attribute `fullScale`). `bayer`: the colours of the first
    two rows of a sensor's mosaic.
    """

    response: Literal["linear", "srgb"] | Positive | None = None
    black: Annotated[float, Field(ge=0)] | None = None
    white: Positive | None = None
    bayer: Literal["RGGB", "BGGR", "GRBG", "GBRG"] | None = None


@dataclass(frozen=True, eq=False)
class Picture:
    """Linear `light (H, W, 3)`, 1 for a full channel; `saturated (H, W)`.

    `full` is the light at which a channel is saturated (inf: never), `quantum (H, W, 3) or ()` the
    light of one step of the file's values.
    """

    light: Floats
    saturated: Bools
    full: float
    quantum: Any


def picture_size(path: Path) -> Size:
    """Width and height from the header. Raises `PictureError`."""
    suffix = path.suffix.lower()
    try:
        if suffix == ".exr":
            low, high = OpenEXR.File(str(path), header_only=True).header()["dataWindow"]
            return int(high[0] - low[0] + 1), int(high[1] - low[1] + 1)
        if suffix in RAW:
            with rawpy.imread(str(path)) as raw:
                return int(raw.sizes.width), int(raw.sizes.height)
    except Exception as error:  # the bindings raise various types
        raise PictureError(_broken(path, error)) from error
    if suffix == ".avif":
        height, width = _avif(path).shape[:2]
        return width, height
    spec = _opened(path).spec()
    return int(spec.width), int(spec.height)


def exposure_of(path: Path) -> tuple[float, str]:
    """Exposure in seconds, and ISO and f-number as text, from EXIF, RAW, or EXR's `exposureTime`
    and `expTime`. Raises `PictureError` without an exposure."""
    suffix = path.suffix.lower()
    try:
        if suffix in RAW:
            with rawpy.imread(str(path)) as raw:
                shot = raw.other
                values = (shot.shutter_speed, shot.iso_speed, shot.aperture)
        elif suffix == ".exr":
            header = OpenEXR.File(str(path), header_only=True).header()
            values = (header.get("exposureTime", header.get("expTime")), 0, 0)
        else:
            spec = _opened(path).spec()
            names = ("ExposureTime", "Exif:PhotographicSensitivity", "FNumber")
            values = tuple(spec.getattribute(name) for name in names)
    except PictureError:
        raise
    except Exception as error:  # the bindings raise various types
        raise PictureError(_broken(path, error)) from error
    seconds, iso, stop = (float(x or 0) for x in values)
    if not 0 < seconds < np.inf:
        raise PictureError(
            f"{path}: no exposure time in the file: give `exposure` in seconds, or {{exposure}} in "
            "the pattern"
        )
    return seconds, f"ISO {iso:g} f/{stop:.3g}"


def read_picture(path: Path, sensor: Sensor, size: Size) -> Picture:
    """Read an image of `size`. Raises `PictureError` for another size or format, or damage."""
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise PictureError(f"{path}: unknown format; expected {' '.join(sorted(FORMATS))}")
    found = picture_size(path)
    if found != size:
        raise PictureError(
            f"{path}: {found[0]}x{found[1]} pixels, expected {size[0]}x{size[1]} as the camera: "
            "replace the image, or remove it (a frame may be missing)"
        )
    if suffix == ".exr":
        return _exr(path, sensor)
    if suffix in RAW:
        return _raw(path, sensor)
    if suffix == ".avif":
        white, response = sensor.white or _avif_white(path), sensor.response or "srgb"
        return _counts(path, _avif(path), replace(sensor, white=white, response=response))
    source = _opened(path)
    values = source.read_image(oiio.UNKNOWN)
    if values is None or source.geterror(False):
        raise PictureError(_broken(path, source.geterror()))
    return _counts(path, np.asarray(values), sensor)


def _avif(path: Path) -> NDArray[Any]:
    """Integer values `(H, W, 3)`; OpenImageIO's wheels do not read AVIF."""
    how = AS_STORED | cv2.IMREAD_COLOR_RGB | cv2.IMREAD_ANYDEPTH
    values = cv2.imread(str(path), how)
    if values is None:
        raise PictureError(_broken(path, "OpenCV cannot read it"))
    return np.asarray(values)


def _avif_white(path: Path) -> float:
    """Largest value, from the `av1C` box ("AV1 Codec ISO Media File Format", 2.3.3)."""
    head = path.read_bytes()[:_AVIF_HEAD]
    at = head.find(b"av1C")
    flags = head[at + 6] if 0 <= at < len(head) - 6 else 0
    return float(2 ** (8 + 2 * (flags >> 6 & 1) + 2 * (flags >> 5 & 1)) - 1)


def _opened(path: Path) -> Any:
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)  # colours are not multiplied by alpha
    source = oiio.ImageInput.open(str(path), config)
    if source is None:
        raise PictureError(_broken(path, oiio.geterror()))
    return source


def _broken(path: Path, error: object) -> str:
    text = " ".join(str(error).split()) or "truncated or damaged"
    return f"{path}: cannot be read ({text}): copy it again, or remove it (a frame may be missing)"


def _exr(path: Path, sensor: Sensor) -> Picture:
    try:
        image, attributes = read_exr(path)
    except OtherChannels as error:
        raise PictureError(str(error)) from error
    except ValueError as error:
        raise PictureError(_broken(path, error)) from error
    if not np.isfinite(image).all():
        raise PictureError(f"{path}: has pixels that are not finite")
    white, black = sensor.white or 1.0, sensor.black or 0.0
    if not black < white:
        raise PictureError(
            f"{path}: black {black:g} must be below white {white:g}: give `white` in the "
            "file's values"
        )
    full = sensor.white or float(attributes.get("fullScale", np.inf))
    saturated = np.asarray((image >= full * (1 - 1e-5)).any(axis=-1))
    gamma = 1.0 if sensor.response is None else sensor.response
    light = _decoded((image - black) / (white - black), gamma)
    quantum = float(attributes.get("countScale", 0.0)) / (white - black)
    return Picture(light, saturated, (full - black) / (white - black), quantum)


def _counts(path: Path, values: NDArray[Any], sensor: Sensor) -> Picture:
    """An image of integers `(H, W, C)`, or of floats in a TIFF."""
    whole = np.issubdtype(values.dtype, np.integer)
    white = sensor.white or (float(np.iinfo(values.dtype).max) if whole else 1.0)
    black = sensor.black or 0.0
    if not black < white:
        raise PictureError(f"{path}: black {black:g} must be below white {white:g}")
    colours = values.shape[-1]
    if sensor.bayer is not None:
        if colours != 1:
            raise PictureError(
                f"{path}: expected one channel for a mosaic ({sensor.bayer}), got {colours}"
            )
        return _mosaic(values[..., 0], sensor.bayer, black, white)
    numbers = np.repeat(values[..., :1], 3, axis=-1) if colours < 3 else values[..., :3]
    if not np.isfinite(numbers).all():
        raise PictureError(f"{path}: has pixels that are not finite")
    share = (numbers.astype(np.float32) - np.float32(black)) / np.float32(white - black)
    full = np.float32(FULL if whole or sensor.white else np.inf)
    saturated = np.asarray((share >= full).any(axis=-1))
    gamma = sensor.response
    if gamma is None:
        gamma = "srgb" if values.dtype == np.uint8 else "linear"
    light = _decoded(share, gamma)
    step = np.float32(1 / (white - black)) if whole else np.float32(0)
    quantum = _decoded(share + step, gamma) - light if gamma != "linear" else step
    return Picture(light, saturated, float(_decoded(full, gamma)), quantum)


def _raw(path: Path, sensor: Sensor) -> Picture:
    try:
        with rawpy.imread(str(path)) as raw:
            values, pattern = raw.raw_image_visible.copy(), raw.raw_pattern
            colours = raw.color_desc.decode()
            blacks, white = list(raw.black_level_per_channel), float(raw.white_level)
    except Exception as error:
        raise PictureError(_broken(path, error)) from error
    bayer = ""
    if pattern is not None and pattern.shape == (2, 2) and values.ndim == 2:
        bayer = "".join(colours[i] for i in pattern.ravel())
    if bayer not in MOSAICS:
        raise PictureError(f"{path}: not a Bayer mosaic: develop it to a linear 16-bit TIFF")
    black = float(np.mean(blacks)) if sensor.black is None else sensor.black
    white = sensor.white or white
    if not black < white:
        raise PictureError(f"{path}: black {black:g} must be below white {white:g}")
    return _mosaic(values, bayer, black, white)


def _mosaic(values: NDArray[Any], bayer: str, black: float, white: float) -> Picture:
    """Linear light of a mosaic `(H, W)`, interpolated along edges, and pixels it saturates."""
    full = black + FULL * (white - black)
    saturated = cv2.dilate((values >= full).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    deep = values.astype(np.uint16)
    shift = max(0, 15 - int(deep.max(initial=1)).bit_length())  # precision below one count
    image = cv2.demosaicing(deep << shift, MOSAICS[bayer]).astype(np.float32) / (1 << shift)
    light = (image - np.float32(black)) / np.float32(white - black)
    return Picture(light, saturated, FULL, 1 / (white - black))


def _decoded(share: Any, response: Literal["linear", "srgb"] | float) -> Any:
    """Linear light of values with white at 1 (IEC 61966-2-1 for sRGB); odd below 0."""
    if response == "linear" or response == 1.0:
        return share
    value = np.abs(share)
    if response == "srgb":
        light = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    else:
        light = value ** float(response)
    return np.asarray(np.sign(share) * light, np.float32)

"""Images of cameras as linear light: EXR, Radiance, PNG, TIFF, JPEG, AVIF and RAW.

OpenImageIO reads all but RAW (rawpy), AVIF (OpenCV), EXR and Radiance. The size is checked before
pixels are read, as a header may claim more than memory.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
import OpenEXR
import rawpy
from numpy.typing import NDArray
from pydantic import Field

from reconstruction.arrays import Bools, Floats
from reconstruction.files.colour import Colour, Curve, decoded
from reconstruction.files.encoded import (
    FORMATS,
    RAW,
    PictureError,
    Placement,
    Size,
    broken,
    opened,
    placement,
    stored_values,
    turned,
)
from reconstruction.files.exr import OtherChannels, read_exr
from reconstruction.files.mosaics import read_mosaic
from reconstruction.files.tiff_tags import dng_levels
from reconstruction.options import options

Positive = Annotated[float, Field(gt=0)]
Row = tuple[float, float, float]
MOSAICS = {
    "RGGB": cv2.COLOR_BayerRGGB2RGB_EA,
    "BGGR": cv2.COLOR_BayerBGGR2RGB_EA,
    "GRBG": cv2.COLOR_BayerGRBG2RGB_EA,
    "GBRG": cv2.COLOR_BayerGBRG2RGB_EA,
}
ASPECT = 0.02
"""Difference of a pixel's aspect from the camera's that is rounding."""
LOSSY = {".jpg", ".jpeg"}
FULL = 0.99
"""Share of the range from black to white at which an integer channel counts as saturated: sensors
are nonlinear near the end."""
_CLIPPED = 64
"""Pixels of a mosaic at its largest value that are a sensor's clipping."""


@options
class Sensor:
    """Conversion of image values to light.

    `response`: "linear", "srgb", or the exponent γ of value = light^(1/γ); None: the file's own
    (gAMA, cICP, ICC), else "srgb" for 8 bits, JPEG and AVIF, else "linear". `black` and `white` in
    the file's values: no light, and a full channel; None: those of the file, else 0 and the largest
    of the type (1 for floats, which saturate only with `white` or the EXR attribute `fullScale`).
    `bayer`: the colours of the first two rows of a sensor's mosaic. `matrix`: rows that take linear
    RGB of the files to linear Rec. 709, after the files' own primaries. `orientation`: whether the
    camera's pixels are those stored, or turned by EXIF; None: by the size, if that decides.
    """

    response: Literal["linear", "srgb"] | Positive | None = None
    black: Annotated[float, Field(ge=0)] | None = None
    white: Positive | None = None
    bayer: Literal["RGGB", "BGGR", "GRBG", "GBRG"] | None = None
    matrix: tuple[Row, Row, Row] | None = None
    orientation: Literal["stored", "turned"] | None = None


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


def picture_size(path: Path, like: Size | None = None) -> Size:
    """Width and height from the header; turned by EXIF where only that fits the camera's size
    `like`, upright or wide; RAW's crop where `like` is its size. Raises `PictureError`."""
    place = placement(path)
    place = place if like is None else place.of_camera(like)
    fits = like is None or (place.size[0] > place.size[1]) == (like[0] > like[1])
    return place.size if fits else place.turned


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
            spec = opened(path).spec()
            names = ("ExposureTime", "Exif:PhotographicSensitivity", "FNumber")
            values = tuple(spec.getattribute(name) for name in names)
    except PictureError:
        raise
    except Exception as error:  # the bindings raise various types
        raise PictureError(broken(path, error)) from error
    seconds, iso, stop = (float(x or 0) for x in values)
    if not 0 < seconds < np.inf:
        raise PictureError(
            f"{path}: no exposure time in the file: give `exposure` in seconds, or {{exposure}} in "
            "the pattern"
        )
    return seconds, f"ISO {iso:g} f/{stop:.3g}"


def response_of(path: Path, sensor: Sensor) -> Curve:
    """The curve by which `read_picture` decodes a file's values. Raises `PictureError`."""
    if sensor.bayer is not None or path.suffix.lower() in RAW:
        return "linear"
    if sensor.response is not None or path.suffix.lower() == ".exr":
        return sensor.response or "linear"
    values, _, colour = stored_values(path)
    return _curve(values, sensor, colour)


def _curve(values: NDArray[Any], sensor: Sensor, colour: Colour) -> Curve:
    curve: Curve | None = sensor.response if sensor.response is not None else colour.curve
    return curve or ("srgb" if values.dtype == np.uint8 else "linear")


def read_picture(
    path: Path, sensor: Sensor, size: Size, aspect: float | None = None, values_only: bool = False
) -> Picture:
    """Read an image of `size`, of a camera whose focal length in pixels down is `aspect` times that
    across; `values_only`: the file's values, 1 at white, without curve, black level or primaries.
    Raises `PictureError` for another size, format or aspect, for damage, and for what the file
    contains but cannot be read as light."""
    suffix = path.suffix.lower()
    if suffix not in FORMATS:
        raise PictureError(f"{path}: unknown format; expected {' '.join(sorted(FORMATS))}")
    whole = placement(path)
    place = whole.of_camera(size)
    turn = _orientation(path, place, sensor, size)
    if aspect is not None and place.aspect != 1 and abs(place.aspect / aspect - 1) > ASPECT:
        raise PictureError(
            f"{path}: pixelAspectRatio {place.aspect:.4g}, but fy / fx of the camera is "
            f"{aspect:.4g}: correct K, or the attribute"
        )
    if values_only:
        black = sensor.black if suffix in RAW else 0.0
        sensor = replace(sensor, response="linear", black=black, matrix=None)
    if suffix == ".exr":
        picture = _exr(path, sensor)
    elif suffix in RAW:
        picture = _raw(path, sensor)
    else:
        values, white, colour = stored_values(path)
        if sensor.white is None and white is not None:
            sensor = replace(sensor, white=white)
        picture = _counts(path, values, sensor, Colour() if values_only else colour)
    if sensor.matrix is not None:
        light = np.asarray(picture.light @ np.array(sensor.matrix).T, np.float32)
        quantum = np.broadcast_to(picture.quantum, light.shape)
        picture = replace(picture, light=light, quantum=quantum)
    if place is not whole and place.crop is not None:
        picture = _cropped(picture, place.crop)
    return _turned_picture(picture, turn)


def _orientation(path: Path, place: Placement, sensor: Sensor, size: Size) -> int:
    """The orientation to apply for a camera of `size`. Raises `PictureError`."""
    turn = 1 if sensor.orientation == "stored" else place.orientation
    fits = {s for s in ("stored", "turned") if size == (place.size, place.turned)[s == "turned"]}
    if not fits or (sensor.orientation and sensor.orientation not in fits):
        raise PictureError(
            f"{path}: {place.size[0]}x{place.size[1]} pixels, expected {size[0]}x{size[1]} as the "
            "camera: replace the image, or remove it (a frame may be missing)"
        )
    if turn == 1 or sensor.orientation:
        return turn
    if len(fits) == 2:
        raise PictureError(
            f"{path}: EXIF orientation {turn} and the camera's size fit both ways: set "
            'sensor.orientation = "stored" if the camera is calibrated on the pixels as stored, '
            'else "turned"'
        )
    return turn if fits == {"turned"} else 1


def _cropped(picture: Picture, crop: tuple[int, int, int, int]) -> Picture:
    left, top, width, height = crop
    at = slice(top, top + height), slice(left, left + width)
    step = picture.quantum if np.ndim(picture.quantum) == 0 else picture.quantum[at]
    light, saturated = picture.light[at], picture.saturated[at]
    return replace(picture, light=light, saturated=saturated, quantum=step)


def _turned_picture(picture: Picture, turn: int) -> Picture:
    if turn == 1:
        return picture
    step = picture.quantum if np.ndim(picture.quantum) == 0 else turned(picture.quantum, turn)
    light, saturated = turned(picture.light, turn), turned(picture.saturated, turn)
    return replace(picture, light=light, saturated=saturated, quantum=step)


def _exr(path: Path, sensor: Sensor) -> Picture:
    try:
        image, attributes = read_exr(path)
    except OtherChannels as error:
        raise PictureError(str(error)) from error
    except ValueError as error:
        raise PictureError(broken(path, error)) from error
    image, infinite = _finite(path, image, np.float16)
    white, black = sensor.white or 1.0, sensor.black or 0.0
    if not black < white:
        raise PictureError(
            f"{path}: black {black:g} must be below white {white:g}: give `white` in the "
            "file's values"
        )
    full = sensor.white or float(attributes.get("fullScale", np.inf))
    if infinite.any():
        full = min(full, float(np.finfo(np.float16).max))
    saturated = np.asarray((image >= full * (1 - 1e-5)).any(axis=-1))
    gamma = 1.0 if sensor.response is None else sensor.response
    light = decoded((image - black) / (white - black), gamma)
    quantum = float(attributes.get("countScale", 0.0)) / (white - black)
    return Picture(light, saturated, (full - black) / (white - black), quantum)


def _finite(path: Path, values: Any, kind: Any) -> tuple[Any, Bools]:
    """`values` with infinity as the largest number of `kind` (beyond the range of half floats is
    saturated), and where it is. Raises `PictureError` for other values that are not finite."""
    infinite = np.isposinf(values)
    if infinite.any():
        values = np.where(infinite, np.finfo(kind).max, values)
    wrong = np.argwhere(~np.isfinite(values))
    if len(wrong):
        row, column, channel = wrong[0]
        raise PictureError(
            f"{path}: {len(wrong)} values are not finite, the first at row {row}, column {column}: "
            f"{values[row, column, channel]}: replace them by numbers"
        )
    return values, np.asarray(infinite.any(axis=-1))


def _counts(path: Path, values: NDArray[Any], sensor: Sensor, colour: Colour) -> Picture:
    """An image of integers `(H, W, C)`, or of floats in a TIFF or Radiance file."""
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
    if whole and sensor.white is None:
        _check_bits(path, values)
    numbers = np.repeat(values[..., :1], 3, axis=-1) if colours < 3 else values[..., :3]
    infinite = None
    if not whole:
        numbers, infinite = _finite(path, numbers, np.float16)
    share = (numbers.astype(np.float32) - np.float32(black)) / np.float32(white - black)
    limit = np.float32(FULL if whole or sensor.white else np.inf)
    if infinite is not None and infinite.any():
        limit = min(limit, np.float32((np.finfo(np.float16).max - black) / (white - black)))
    saturated = np.asarray((share >= limit).any(axis=-1))
    gamma = _curve(values, sensor, colour)
    light = decoded(share, gamma)
    step = np.float32(1 / (white - black)) if whole else np.float32(0)
    quantum = decoded(share + step, gamma) - light if gamma != "linear" else step
    full = float(decoded(limit, gamma))
    if colour.matrix is not None:
        light = np.asarray(light @ colour.matrix.T, np.float32)
        quantum = np.broadcast_to(quantum, light.shape)
    return Picture(light, saturated, full, quantum)


def _check_bits(path: Path, values: NDArray[Any]) -> None:
    """Raise `PictureError` where 16 bits hold a sensor's 10, 12 or 14 that clip."""
    most = int(values.max(initial=0))
    if values.dtype != np.uint16 or most not in (1023, 4095, 16383):
        return
    if (values == most).sum() >= max(_CLIPPED, 8 * (values == most - 1).sum()):
        bits = most.bit_length()
        raise PictureError(
            f"{path}: 16 bits, but values end at {most} as of {bits} bits: set sensor.white = "
            f"{most} (65535 if they do not)"
        )


def _raw(path: Path, sensor: Sensor) -> Picture:
    try:
        mosaic = read_mosaic(str(path))
    except Exception as error:
        raise PictureError(broken(path, error)) from error
    values, bayer, sites = mosaic.values, mosaic.bayer, mosaic.sites
    if bayer not in MOSAICS:
        raise PictureError(f"{path}: not a Bayer mosaic: develop it to a linear 16-bit TIFF")
    try:
        levels = mosaic.black[sites], mosaic.white[sites]
        if path.suffix.lower() == ".dng":
            levels = dng_levels(path, values.shape, sites)
    except ValueError as error:
        raise PictureError(f"{path}: {error}") from error
    except Exception as error:  # of wrong tags
        raise PictureError(broken(path, error)) from error
    low, high = (
        x if given is None else np.full(values.shape, given)
        for x, given in zip(levels, (sensor.black, sensor.white), strict=True)
    )
    black, top = float(low.mean()), float(high.max())
    if not (low < high).all():
        raise PictureError(f"{path}: black {low.max():g} must be below white {high.min():g}")
    if (low != black).any() or (high != top).any():
        values = black + (values - low) * ((top - black) / (high - low))
        below = min(0.0, float(values.min()))  # demosaicing needs positive numbers
        values, black, top = values - below, black - below, top - below
    clips = top if sensor.white else min(top, _clipping(values))
    return _mosaic(values, bayer, black, top, clips)


def _clipping(values: NDArray[Any]) -> float:
    """The value at which a mosaic's sensor clips, if the image has such pixels, else inf: many at
    the largest value, few at each of those below."""
    counts = np.rint(values).clip(0).astype(np.int64)
    most = int(counts.max(initial=0))
    below = np.bincount(counts.ravel(), minlength=most + 1)[int(0.9 * most) : -1]
    many = int((counts == most).sum())
    found = many >= max(_CLIPPED, 8 * below.max(initial=0)) and (below > 0).sum() >= 8
    return float(most) if found else np.inf


def _mosaic(
    values: NDArray[Any], bayer: str, black: float, white: float, clips: float = np.inf
) -> Picture:
    """Linear light of a mosaic `(H, W)`, interpolated along edges, and pixels it saturates: near
    `white`, or `clips` if the sensor saturates below it."""
    full = black + FULL * (min(white, clips) - black)
    saturated = cv2.dilate((values >= full).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    shift = max(0, 15 - int(values.max(initial=1)).bit_length())  # precision below one count
    deep = np.rint(np.clip(values * float(1 << shift), 0, 65535)).astype(np.uint16)
    image = cv2.demosaicing(deep, MOSAICS[bayer]).astype(np.float32) / (1 << shift)
    light = (image - np.float32(black)) / np.float32(white - black)
    return Picture(light, saturated, (full - black) / (white - black), 1 / (white - black))

"""Counts from the files of cameras that store photographs: RAW (LibRaw) and JPEG.

A file's own black level becomes `BLACK` and its white level `FULL`, so that all files of a camera
have one scale.
"""

from __future__ import annotations

import io

import cv2
import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import Array
from reconstruction.files.colour import decoded
from reconstruction.files.mosaics import read_mosaic
from stage_service.devices.cameras import pixel_formats

BLACK, FULL = 4096, 65535
JPEG = b"\xff\xd8\xff"
"""First bytes of a JPEG file."""


def counts(data: bytes) -> NDArray[np.uint16]:
    """Linear counts `(H, W, 3)` RGB of a file's content, the pixels as stored.

    RAW is demosaiced bilinearly; JPEG is decoded by the sRGB curve, which no camera follows
    exactly. Raises `ValueError` with the reason for content that is neither, or no Bayer mosaic.
    """
    return _jpeg(data) if data.startswith(JPEG) else _raw(data)


def _raw(data: bytes) -> NDArray[np.uint16]:
    try:
        mosaic = read_mosaic(io.BytesIO(data))
    except Exception as error:  # LibRaw's are of various types, some with bytes
        why = error.args[0] if error.args else type(error).__name__
        raise ValueError(why.decode() if isinstance(why, bytes) else str(why)) from error
    if mosaic.bayer[:2] not in pixel_formats.DEMOSAIC:
        raise ValueError("a sensor without a Bayer mosaic")
    if not (mosaic.black < mosaic.white).all():
        raise ValueError(f"black levels {mosaic.black} and white levels {mosaic.white}")
    scale = (FULL - BLACK) / (mosaic.white - mosaic.black)
    scaled = np.empty_like(mosaic.values)
    for y, x in np.ndindex(2, 2):
        site = mosaic.sites[y, x]
        table = _whole((np.arange(1 << 16) - mosaic.black[site]) * scale[site])
        scaled[y::2, x::2] = table[mosaic.values[y::2, x::2]]
    return pixel_formats.rgb(scaled, f"Bayer{mosaic.bayer[:2]}16")


def _jpeg(data: bytes) -> NDArray[np.uint16]:
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    if image is None:
        raise ValueError("a damaged JPEG file")
    light = decoded(np.arange(256, dtype=np.float32) / 255, "srgb")
    return _whole(light * (FULL - BLACK))[image[..., ::-1]]


def _whole(above_black: Array) -> NDArray[np.uint16]:
    return np.rint(np.clip(above_black + BLACK, 0, FULL)).astype(np.uint16)

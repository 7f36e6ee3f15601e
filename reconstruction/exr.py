"""OpenEXR files in and out: `(H, W, 3)` images and their header attributes."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import OpenEXR
from numpy.typing import NDArray


def read_exr(path: str | Path) -> tuple[NDArray[np.float32], dict[str, float | str]]:
    """Read an RGB image `(H, W, 3)` and the header attributes that `write_exr` was given.

    Raises `ValueError` that names the file when it is missing, broken or not RGB.
    """
    try:
        file = OpenEXR.File(str(path))
        pixels = file.channels()["RGB"].pixels
    except KeyError:
        raise ValueError(f"{path}: expected the channels R, G and B") from None
    except Exception as error:  # the binding raises bare RuntimeError and MemoryError alike
        raise ValueError(f"{path}: cannot be read as OpenEXR ({error})") from error
    attributes = {k: v for k, v in file.header().items() if isinstance(v, float | str)}
    return np.ascontiguousarray(pixels, dtype=np.float32), attributes


def write_exr(
    path: str | Path,
    image: NDArray[np.floating],
    attributes: Mapping[str, float | str] | None = None,
    *,
    compress: bool = True,
) -> None:
    """Write `image (H, W, 3)` losslessly as float32 RGB: temporary name, fsync, rename."""
    path = Path(path)
    if image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(f"{path}: expected an image of shape (H, W, 3), got {image.shape}")
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION if compress else OpenEXR.NO_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        **(attributes or {}),
    }
    pixels = np.ascontiguousarray(image, dtype=np.float32)
    temporary = path.with_name(path.name + ".part")
    OpenEXR.File(header, {"RGB": pixels}).write(str(temporary))
    replace_durably(temporary, path)


def replace_durably(temporary: Path, path: Path) -> None:
    """Flush `temporary` to disk and rename it to `path`: afterwards it is whole or not there."""
    with temporary.open("rb") as file:
        os.fsync(file.fileno())
    temporary.replace(path)

"""A sensor's mosaic from a RAW file, by LibRaw."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
import rawpy
from numpy.typing import NDArray

from reconstruction.arrays import Array


@dataclass(frozen=True, eq=False)
class Mosaic:
    """The `values (H, W)` that a sensor sent. `bayer`: the colours of the first two rows, "" where
    it has no Bayer mosaic. `black (4,)` and `white (4,)`: values without light and of a full
    channel, by the number in `sites (H, W)`."""

    values: NDArray[Any]
    bayer: str
    sites: NDArray[Any]
    black: Array
    white: Array


def read_mosaic(source: str | BinaryIO) -> Mosaic:
    """The mosaic of a RAW file. Raises what LibRaw raises."""
    with rawpy.imread(source) as raw:
        values, pattern = raw.raw_image_visible.copy(), raw.raw_pattern
        colours = raw.color_desc.decode()
        sites = raw.raw_colors_visible.copy()
        black, whites = raw.black_level_per_channel, raw.camera_white_level_per_channel
        white = np.full(4, float(raw.white_level))
    bayer = ""
    if pattern is not None and pattern.shape == (2, 2) and values.ndim == 2:
        bayer = "".join(colours[i] for i in pattern.ravel())
    if whites is not None and all(0 < w <= white[0] for w in whites):
        white = np.array(whites, float)  # where the sensor clips, from the maker's notes
    return Mosaic(values, bayer, sites, np.array(black, float), white)

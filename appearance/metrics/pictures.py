"""Comparisons of captured and rendered images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from reconstruction.arrays import AnyFloats, Floats
from reconstruction.geometry.blocks import block_means

GROUND, INK = "#08090a", "#c3c8cd"
"""The console's dark theme."""
LARGEST = 640
"""Pixels on a side of what a comparison shows, at most."""
Row = tuple[str, Mapping[str, AnyFloats], Mapping[str, str]]


def small(picture: AnyFloats) -> Floats:
    """Image values `(H, W, 3)` reduced to the size of a comparison."""
    return block_means(picture, -(-max(picture.shape[:2]) // LARGEST))


def comparison_picture(
    path: Path, rows: Sequence[Row], columns: Sequence[str], *, height: float = 2.6
) -> None:
    """Write a PNG of `rows` (label, image values `(H, W, 3)` by column, captions by column)."""
    # the object interface: pyplot keeps figures alive and wants a display
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if not rows:
        raise ValueError(f"{path}: nothing to compare: no camera and no light is held out")
    figure = Figure(
        figsize=(height * len(columns) + 1.2, (height + 0.25) * len(rows) + 0.3),
        layout="constrained",
        facecolor=GROUND,
    )
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(rows), len(columns), squeeze=False)
    for i, (label, pictures, captions) in enumerate(rows):
        for j, column in enumerate(columns):
            axis = axes[i][j]
            axis.imshow(np.clip(pictures[column], 0, 1), interpolation="bicubic")
            axis.set_xticks([])
            axis.set_yticks([])
            for spine in axis.spines.values():
                spine.set_visible(False)
            if i == 0:
                axis.set_title(column.replace("_", " "), fontsize=11, color=INK)
            if j == 0:
                axis.set_ylabel(label, fontsize=9, color=INK)
            if column in captions:
                axis.set_xlabel(captions[column], fontsize=8, color=INK, labelpad=2)
    figure.savefig(path, dpi=110)


def write_png(path: Path, picture: AnyFloats) -> None:
    """Write image values `(H, W, 3)` in [0, 1] as an 8-bit PNG."""
    values = np.rint(np.clip(picture, 0, 1) * 255).astype(np.uint8)
    if not cv2.imwrite(str(path), values[..., ::-1]):
        raise OSError(f"{path} cannot be written")

"""The lengths that a capture resolves, from which those of a reconstruction follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from reconstruction.arrays import AnyFloats, Array
from reconstruction.geometry.cameras import Camera
from reconstruction.reconstruct_options import ReconstructOptions

RESOLVED = 2.0
"""Pixels between lines that an image shows as two (Nyquist)."""

# Between these bounds, metres, a length is a multiple of the pixel. Hair lies in wisps some
# millimetres wide: above, points would skip them. Finer voxels of a whole head fill the memory.
_THIN = (1.25, 1e-4, 2e-3)
_TOLERANCE = (5 / 3, 6e-4, 4e-3)
_MARGIN = (1.1, 5e-4, 2e-3)
_GRID = (5 / 3, 1e-3, 2e-3)


@dataclass(frozen=True)
class CaptureScale:
    """Lengths of a reconstruction, metres.

    `pixel`: the width of a camera's pixel on the hair, the median over cameras. `thin`: between
    measured points. `tolerance`: behind a camera's depth up to which a point is visible. `margin`:
    of the envelope in front of the visible surface. `grid`: a voxel's edge.
    """

    pixel: float
    thin: float
    tolerance: float
    margin: float
    grid: float

    @classmethod
    def of(
        cls,
        cameras: Sequence[Camera],
        points: AnyFloats,
        options: ReconstructOptions = ReconstructOptions(),
    ) -> CaptureScale:
        """For `points (N, 3)` on the hair or the head, n > 0; lengths of the `options` stay."""
        return cls.of_pixel(pixel_size(cameras, np.median(points, axis=0)), options)

    @classmethod
    def of_pixel(
        cls, pixel: float, options: ReconstructOptions = ReconstructOptions()
    ) -> CaptureScale:
        """For a `pixel` of so many metres; lengths of the `options` stay."""

        def length(given: float | None, rule: tuple[float, float, float]) -> float:
            return float(np.clip(rule[0] * pixel, *rule[1:])) if given is None else given

        measure = options.measure
        return cls(
            pixel,
            length(measure.thin, _THIN),
            length(measure.tolerance, _TOLERANCE),
            length(options.margin, _MARGIN),
            length(options.grid, _GRID),
        )

    @property
    def resolution(self) -> str:
        """What the pixels separate, as a sentence without its full stop."""
        return (
            f"pixels of {1e3 * self.pixel:.2g} mm: hairs closer than "
            f"{1e3 * RESOLVED * self.pixel:.2g} mm cannot be separated"
        )

    def figures(self) -> dict[str, Any]:
        """Millimetres, JSON-ready, and the distance of lines that images resolve."""
        names = ("pixel", "thin", "tolerance", "margin", "grid")
        return {
            **{f"{name}_mm": 1e3 * getattr(self, name) for name in names},
            "resolved_mm": 1e3 * RESOLVED * self.pixel,
        }


def pixel_size(cameras: Sequence[Camera], middle: Array) -> float:
    """Metres that one pixel spans at `middle (3,)`, the median over the cameras."""
    return float(np.median([c.project(middle[None])[1][0] / c.K[0, 0] for c in cameras]))

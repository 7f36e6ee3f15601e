"""Line projectors: pinholes that light one row at a time."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from reconstruction.arrays import Array
from reconstruction.geometry.cameras import Pinhole


@dataclass(frozen=True, eq=False)
class Projector(Pinhole):
    """A projector that shows one row (`scanline`) of `height` at a time, or all of them.

    `intensity (3,)` is the radiant intensity, W/sr per channel, towards any direction inside the
    frustum when every row is on. A single row is blurred across rows by a Gaussian of `line_sigma`
    rows; the rows of a sweep sum to the all-on image.
    """

    intensity: Array = field(default_factory=lambda: np.ones(3))
    line_sigma: float = 0.6

    def __post_init__(self) -> None:
        super().__post_init__()
        intensity = np.array(self.intensity, dtype=np.float64)
        if intensity.shape != (3,) or not np.isfinite(intensity).all() or (intensity < 0).any():
            raise ValueError(f"{self.name}: intensity must be 3 numbers >= 0, got {intensity}")
        object.__setattr__(self, "intensity", intensity)
        if not self.line_sigma > 0:
            raise ValueError(f"{self.name}: line_sigma must be positive, got {self.line_sigma}")

    def plane(self, row: ArrayLike) -> Array:
        """Planes of light `(..., 4)` of the (fractional) rows `(...)`: n·x + d = 0, |n| = 1."""
        y = (np.asarray(row, float) - self.K[1, 2]) / self.K[1, 1]
        local = np.stack([np.zeros_like(y), np.ones_like(y), -y], axis=-1)
        normal = local @ self.R
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        return np.concatenate([normal, -(normal @ self.center)[..., None]], axis=-1)

    def row_weight(self, row: ArrayLike, v: ArrayLike) -> Array:
        """Share `(...)` of the all-on light that reaches row `v` when `row` alone is lit."""
        from scipy.special import ndtr  # slow to load, and rigs alone do not need it

        offset = np.asarray(row, float) - np.asarray(v, float)
        above, below = ((offset + s) / self.line_sigma for s in (0.5, -0.5))
        return np.asarray(ndtr(above) - ndtr(below))

    def to_dict(self) -> dict[str, Any]:
        """A JSON-ready description that `Rig.from_dict` reads back exactly."""
        own = {"intensity": self.intensity.tolist(), "line_sigma": self.line_sigma}
        return super().to_dict() | own

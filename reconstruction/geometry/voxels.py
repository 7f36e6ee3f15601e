"""Boolean volumes of cubic voxels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from reconstruction.arrays import Array, Bools, Ints


@dataclass(frozen=True, eq=False)
class VoxelGrid:
    """A boolean volume `inside (nx, ny, nz)`.

    `origin (3,)` is the centre of voxel (0, 0, 0), `spacing` the voxels' edge, both in metres.
    """

    origin: Array
    spacing: float
    inside: Bools

    def __post_init__(self) -> None:
        origin = np.array(self.origin, dtype=np.float64)
        inside = np.ascontiguousarray(self.inside, dtype=bool)
        if origin.shape != (3,) or not np.isfinite(origin).all():
            raise ValueError(f"a voxel grid's origin must be 3 finite numbers, got {self.origin}")
        if not self.spacing > 0 or inside.ndim != 3:
            raise ValueError(
                f"a voxel grid needs spacing > 0 and three axes, got {self.spacing}, {inside.shape}"
            )
        object.__setattr__(self, "origin", origin)
        object.__setattr__(self, "inside", inside)

    def centers(self, index: ArrayLike | None = None) -> Array:
        """World positions `(M, 3)` of voxel indices `(M, 3)`; of all inside voxels by default."""
        ijk = np.argwhere(self.inside) if index is None else np.asarray(index)
        return np.asarray(self.origin + self.spacing * ijk)

    def index(self, points: ArrayLike) -> Ints:
        """Indices `(..., 3)` of the voxels around `points (..., 3)`; they may lie off the grid."""
        q = (np.asarray(points, float) - self.origin) / self.spacing
        return np.floor(q + 0.5).astype(np.int64)

    def contains(self, points: ArrayLike) -> Bools:
        """Whether `points (..., 3)` lie in an inside voxel; off the grid counts as outside."""
        ijk = self.index(points)
        on: Bools = np.asarray(((ijk >= 0) & (ijk < self.inside.shape)).all(axis=-1))
        i, j, k = np.moveaxis(np.where(on[..., None], ijk, 0), -1, 0)
        found: Bools = self.inside[i, j, k] if self.inside.size else np.zeros(on.shape, bool)
        return np.asarray(on & found)

    @property
    def volume(self) -> float:
        """Cubic metres inside."""
        return float(self.inside.sum()) * self.spacing**3

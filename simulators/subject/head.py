"""What hair slides along on the procedural head, which is `reconstruction`'s generic one."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import map_coordinates

from reconstruction.arrays import Array
from reconstruction.geometry.signed_distance import blend, ellipsoid
from reconstruction.head.generic import HEAD_BOX, NECK_END, skin_distance


@dataclass(frozen=True, eq=False)
class HeadField:
    """Signed distance (metres, negative inside) sampled on a grid, for hair to slide along."""

    distance: Array
    gradient: Array
    low: Array
    cell: float

    @classmethod
    def of(cls, points_to_distance: object, cell: float = 0.004) -> HeadField:
        """Sample a distance function `(..., 3) -> (...)` over the head's box."""
        assert callable(points_to_distance)
        axes = [np.arange(a, b + cell, cell) for a, b in HEAD_BOX.T]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        distance = points_to_distance(grid)
        gradient = np.stack(np.gradient(distance, cell), axis=0)
        return cls(distance, gradient, HEAD_BOX[0], cell)

    def __call__(self, points: Array) -> tuple[Array, Array]:
        """Distances `(N,)` and unit outward directions `(N, 3)` at `points (N, 3)`."""
        at = ((points - self.low) / self.cell).T
        distance = map_coordinates(self.distance, at, order=1, mode="nearest")
        out = np.stack(
            [map_coordinates(g, at, order=1, mode="nearest") for g in self.gradient], axis=1
        )
        length = np.linalg.norm(out, axis=1, keepdims=True)
        return distance / np.maximum(length[:, 0], 0.3), out / np.maximum(length, 1e-9)


def hair_distance(points: ArrayLike) -> Array:
    """What hair slides along, metres `(N,)` at `points (N, 3)`: the skin, filled in front so
    that hair passes beside the face."""
    p = np.asarray(points, float)
    skin = skin_distance(np.where(p[..., 2:] < NECK_END + 0.01, _above_cut(p), p))
    guard = ellipsoid(p, [0, -0.062, -0.040], [0.066, 0.075, 0.105])
    return blend(skin, guard, 0.01)


def _above_cut(p: Array) -> Array:
    """Points lifted above the neck's flat end, so that hair sees an endless neck."""
    lifted = p.copy()
    lifted[..., 2] = NECK_END + 0.01
    return lifted


@cache
def hair_field() -> HeadField:
    """The sampled `hair_distance`."""
    return HeadField.of(hair_distance)

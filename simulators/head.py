"""A procedural head: an implicit surface of blended ellipsoids, meshed once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import map_coordinates
from skimage.measure import marching_cubes

from reconstruction.mesh import Mesh

Array = NDArray[np.float64]

_LOW = np.array([-0.15, -0.19, -0.20])
_HIGH = np.array([0.15, 0.19, 0.19])
_CELL = 0.005  # mesh cells: ears and lips survive, and a ray tracer is spared needless triangles
_NECK_END = -0.165
# Height of the hairline over the front-back coordinate: forehead, temple, sideburn, ear, nape.
_HAIRLINE = PchipInterpolator(
    [-0.100, -0.080, -0.050, -0.025, -0.010, 0.010, 0.035, 0.050, 0.075, 0.110],
    [0.066, 0.064, 0.046, 0.024, 0.008, 0.022, 0.016, -0.030, -0.048, -0.052],
)


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
        axes = [np.arange(a, b + cell, cell) for a, b in zip(_LOW, _HIGH, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        distance = points_to_distance(grid)
        gradient = np.stack(np.gradient(distance, cell), axis=0)
        return cls(distance, gradient, _LOW, cell)

    def __call__(self, points: Array) -> tuple[Array, Array]:
        """Distances `(N,)` and unit outward directions `(N, 3)` at `points (N, 3)`."""
        at = ((points - self.low) / self.cell).T
        distance = map_coordinates(self.distance, at, order=1, mode="nearest")
        out = np.stack(
            [map_coordinates(g, at, order=1, mode="nearest") for g in self.gradient], axis=1
        )
        length = np.linalg.norm(out, axis=1, keepdims=True)
        return distance / np.maximum(length[:, 0], 0.3), out / np.maximum(length, 1e-9)


def _ellipsoid(p: Array, center: ArrayLike, radii: ArrayLike, tilt_deg: float = 0.0) -> Array:
    """Approximate signed distance to an ellipsoid turned by `tilt_deg` about x."""
    c, s = np.cos(np.radians(tilt_deg)), np.sin(np.radians(tilt_deg))
    q = p - np.asarray(center)
    q = np.stack([q[..., 0], c * q[..., 1] - s * q[..., 2], s * q[..., 1] + c * q[..., 2]], -1)
    r = np.asarray(radii)
    k0 = np.linalg.norm(q / r, axis=-1)
    k1 = np.linalg.norm(q / (r * r), axis=-1)
    return np.asarray(k0 * (k0 - 1) / np.maximum(k1, 1e-9))


def _capsule(p: Array, a: ArrayLike, b: ArrayLike, r_a: float, r_b: float) -> Array:
    a, b = np.asarray(a, float), np.asarray(b, float)
    h = np.clip((p - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
    return np.asarray(
        np.linalg.norm(p - a - h[..., None] * (b - a), axis=-1) - r_a - h * (r_b - r_a)
    )


def _blend(a: Array, b: Array, width: float) -> Array:
    """Union whose seam is rounded over `width` metres (polynomial smooth minimum)."""
    h = np.clip(0.5 + 0.5 * (b - a) / width, 0, 1)
    return b + h * (a - b) - width * h * (1 - h)


def _carve(a: Array, b: Array, width: float) -> Array:
    """`a` without `b`, the edge rounded over `width` metres."""
    return -_blend(-a, b, width)


def _ears(p: Array) -> Array:
    m = np.stack([np.abs(p[..., 0]), p[..., 1], p[..., 2]], -1)
    # The pinna leans back and stands off the skull: shear x against y before the ellipsoid.
    m[..., 0] -= 0.30 * (m[..., 1] - 0.012)
    shell = _ellipsoid(m, [0.076, 0.014, -0.006], [0.007, 0.018, 0.031], 12)
    lobe = _ellipsoid(m, [0.073, 0.006, -0.033], [0.006, 0.009, 0.011])
    hollow = _ellipsoid(m, [0.083, 0.011, -0.003], [0.006, 0.011, 0.020], 12)
    return _carve(_blend(shell, lobe, 0.008), hollow, 0.004)


def skin_distance(points: ArrayLike) -> Array:
    """Signed distance to the skin `(...)`, metres, of `points (..., 3)`; negative inside."""
    p = np.asarray(points, float)
    m = np.stack([np.abs(p[..., 0]), p[..., 1], p[..., 2]], -1)  # the face is symmetric
    d = _ellipsoid(p, [0, 0.010, 0.032], [0.074, 0.093, 0.083])
    d = _blend(d, _ellipsoid(p, [0, -0.030, -0.030], [0.060, 0.058, 0.078], 12), 0.030)
    d = _blend(d, _ellipsoid(m, [0.046, 0.000, -0.062], [0.014, 0.030, 0.022], 30), 0.030)
    d = _blend(d, _ellipsoid(p, [0, -0.074, -0.098], [0.022, 0.017, 0.016]), 0.025)
    d = _blend(d, _ellipsoid(m, [0.041, -0.058, -0.018], [0.020, 0.020, 0.018]), 0.025)
    d = _blend(d, _capsule(m, [0, -0.083, 0.028], [0.040, -0.068, 0.026], 0.009, 0.008), 0.018)
    d = _carve(d, _ellipsoid(m, [0.032, -0.097, 0.006], [0.019, 0.018, 0.013]), 0.016)
    d = _blend(d, _ellipsoid(m, [0.032, -0.0745, 0.005], [0.0135, 0.0125, 0.0115]), 0.004)
    d = _blend(d, _capsule(p, [0, -0.085, 0.020], [0, -0.109, -0.024], 0.0075, 0.0095), 0.012)
    d = _blend(d, _ellipsoid(m, [0.011, -0.096, -0.030], [0.008, 0.010, 0.007]), 0.007)
    d = _blend(d, _ellipsoid(p, [0, -0.086, -0.058], [0.025, 0.012, 0.006]), 0.008)
    d = _blend(d, _ellipsoid(p, [0, -0.085, -0.070], [0.021, 0.012, 0.007]), 0.007)
    d = _carve(d, _capsule(m, [0, -0.100, -0.0635], [0.024, -0.090, -0.064], 0.0022, 0.0015), 0.003)
    d = _blend(d, _ears(p), 0.006)
    neck = _capsule(p, [0, 0.026, -0.05], [0, 0.034, -0.25], 0.049, 0.058)
    d = _blend(d, neck, 0.030)
    return np.maximum(d, _NECK_END - p[..., 2])


def hair_distance(points: ArrayLike) -> Array:
    """What hair slides along: the skin, filled in front so that hair passes beside the face."""
    p = np.asarray(points, float)
    skin = skin_distance(np.where(p[..., 2:] < _NECK_END + 0.01, _above_cut(p), p))
    guard = _ellipsoid(p, [0, -0.062, -0.040], [0.066, 0.075, 0.105])
    return _blend(skin, guard, 0.01)


def _above_cut(p: Array) -> Array:
    """Points lifted above the neck's flat end, so that hair sees an endless neck."""
    lifted = p.copy()
    lifted[..., 2] = _NECK_END + 0.01
    return lifted


@cache
def head_mesh() -> Mesh:
    """The head `Mesh`: watertight, z up, face towards −y, origin at its centre, scalp marked.

    About 15 cm wide without ears, 19 cm deep without the nose and 23 cm from chin to crown, with
    a neck cut flat.
    """
    axes = [np.arange(a, b, _CELL) for a, b in zip(_LOW, _HIGH, strict=True)]
    field = skin_distance(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1))
    vertices, faces, _, _ = marching_cubes(field, 0.0, spacing=(_CELL,) * 3)
    vertices = vertices.astype(float) + _LOW
    mesh = Mesh(vertices, faces.astype(np.int64))
    volume = np.einsum(
        "ij,ij->", vertices[faces[:, 0]], np.cross(vertices[faces[:, 1]], vertices[faces[:, 2]])
    )
    if volume < 0:
        mesh = Mesh(vertices, faces[:, ::-1].astype(np.int64))
    middle = mesh.vertices[mesh.faces].mean(axis=1)
    scalp = (middle[:, 2] > _HAIRLINE(np.clip(middle[:, 1], -0.1, 0.11))) & (_ears(middle) > 0.007)
    return Mesh(mesh.vertices, mesh.faces, scalp)


@cache
def hair_field() -> HeadField:
    """The sampled `hair_distance`."""
    return HeadField.of(hair_distance)

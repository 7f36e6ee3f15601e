"""The generic head: blended ellipsoids, meshed once, with a marked scalp."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import PchipInterpolator
from skimage.measure import marching_cubes

from reconstruction.arrays import Array
from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.signed_distance import blend, capsule, carve, ellipsoid

HEAD_BOX = np.array([[-0.15, -0.19, -0.20], [0.15, 0.19, 0.19]])
"""Corners `(2, 3)` of a box around the head with margin, metres."""

NECK_END = -0.165  # height, metres, at which the neck is cut flat
_CELL = 0.005  # metres: resolves ears and lips
# Height of the hairline over the front-back coordinate: forehead, temple, sideburn, ear, nape.
_HAIRLINE = PchipInterpolator(
    [-0.100, -0.080, -0.050, -0.025, -0.010, 0.010, 0.035, 0.050, 0.075, 0.110],
    [0.066, 0.064, 0.046, 0.024, 0.008, 0.022, 0.016, -0.030, -0.048, -0.052],
)


def _ears(p: Array) -> Array:
    m = np.stack([np.abs(p[..., 0]), p[..., 1], p[..., 2]], -1)
    # The pinna leans back and stands off the skull: shear x against y before the ellipsoid.
    m[..., 0] -= 0.30 * (m[..., 1] - 0.012)
    shell = ellipsoid(m, [0.076, 0.014, -0.006], [0.007, 0.018, 0.031], 12)
    lobe = ellipsoid(m, [0.073, 0.006, -0.033], [0.006, 0.009, 0.011])
    hollow = ellipsoid(m, [0.083, 0.011, -0.003], [0.006, 0.011, 0.020], 12)
    return carve(blend(shell, lobe, 0.008), hollow, 0.004)


def skin_distance(points: ArrayLike) -> Array:
    """Signed distance to the skin `(...)`, metres, of `points (..., 3)`; negative inside."""
    p = np.asarray(points, float)
    m = np.stack([np.abs(p[..., 0]), p[..., 1], p[..., 2]], -1)  # the face is symmetric
    d = ellipsoid(p, [0, 0.010, 0.032], [0.074, 0.093, 0.083])
    d = blend(d, ellipsoid(p, [0, -0.030, -0.030], [0.060, 0.058, 0.078], 12), 0.030)
    d = blend(d, ellipsoid(m, [0.046, 0.000, -0.062], [0.014, 0.030, 0.022], 30), 0.030)
    d = blend(d, ellipsoid(p, [0, -0.074, -0.098], [0.022, 0.017, 0.016]), 0.025)
    d = blend(d, ellipsoid(m, [0.041, -0.058, -0.018], [0.020, 0.020, 0.018]), 0.025)
    d = blend(d, capsule(m, [0, -0.083, 0.028], [0.040, -0.068, 0.026], 0.009, 0.008), 0.018)
    d = carve(d, ellipsoid(m, [0.032, -0.097, 0.006], [0.019, 0.018, 0.013]), 0.016)
    d = blend(d, ellipsoid(m, [0.032, -0.0745, 0.005], [0.0135, 0.0125, 0.0115]), 0.004)
    d = blend(d, capsule(p, [0, -0.085, 0.020], [0, -0.109, -0.024], 0.0075, 0.0095), 0.012)
    d = blend(d, ellipsoid(m, [0.011, -0.096, -0.030], [0.008, 0.010, 0.007]), 0.007)
    d = blend(d, ellipsoid(p, [0, -0.086, -0.058], [0.025, 0.012, 0.006]), 0.008)
    d = blend(d, ellipsoid(p, [0, -0.085, -0.070], [0.021, 0.012, 0.007]), 0.007)
    d = carve(d, capsule(m, [0, -0.100, -0.0635], [0.024, -0.090, -0.064], 0.0022, 0.0015), 0.003)
    d = blend(d, _ears(p), 0.006)
    neck = capsule(p, [0, 0.026, -0.05], [0, 0.034, -0.25], 0.049, 0.058)
    d = blend(d, neck, 0.030)
    return np.maximum(d, NECK_END - p[..., 2])


@cache
def generic_head() -> Mesh:
    """The head `Mesh`: watertight, z up, face towards −y, origin at its centre, scalp marked.

    About 15 cm wide without ears, 19 cm deep without the nose and 23 cm from chin to crown, with
    a neck cut flat.
    """
    axes = [np.arange(a, b, _CELL) for a, b in HEAD_BOX.T]
    field = skin_distance(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1))
    vertices, faces, _, _ = marching_cubes(field, 0.0, spacing=(_CELL,) * 3)
    vertices = vertices.astype(float) + HEAD_BOX[0]
    mesh = Mesh(vertices, faces.astype(np.int64))
    a, b, c = vertices[faces].transpose(1, 0, 2)
    if np.einsum("ij,ij->", a, np.cross(b, c)) < 0:  # the volume
        mesh = Mesh(vertices, faces[:, ::-1].astype(np.int64))
    middle = mesh.vertices[mesh.faces].mean(axis=1)
    scalp = (middle[:, 2] > _HAIRLINE(np.clip(middle[:, 1], -0.1, 0.11))) & (_ears(middle) > 0.007)
    return Mesh(mesh.vertices, mesh.faces, scalp)

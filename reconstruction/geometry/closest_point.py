"""The closest point of a triangle mesh."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from reconstruction.arrays import AnyFloats, Array, Bools, Ints
from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.mesh_queries import surface_samples

_CANDIDATES = 6


class ClosestPoint:
    """Finds closest points of `mesh`: exact among the faces of the six nearest samples.

    Samples lie `spacing` metres apart: a distance is at most about `spacing` too large. `faces
    (F,) bool` restricts the search.
    """

    def __init__(self, mesh: Mesh, spacing: float, faces: Bools | None = None) -> None:
        samples, _, face = surface_samples(mesh, spacing)
        if faces is not None:
            samples, face = samples[faces[face]], face[faces[face]]
        if not len(samples):
            raise ValueError("no faces to find a closest point on")
        self._corners = mesh.vertices[mesh.faces]
        self._face = face
        self._tree = cKDTree(samples)

    def __call__(self, points: AnyFloats) -> tuple[Ints, Array, Array]:
        """Faces `(N,)`, barycentric coordinates `(N, 3)`, distances `(N,)` of `points (N, 3)`."""
        at: Array = np.asarray(points, np.float64)
        k = min(_CANDIDATES, len(self._face))
        _, near = self._tree.query(at, k=np.arange(1, k + 1))
        face = self._face[near]
        weights = closest_on_triangles(at[:, None], self._corners[face])
        found = np.einsum("nkc,nkcd->nkd", weights, self._corners[face])
        distance = np.linalg.norm(found - at[:, None], axis=2)
        row, best = np.arange(len(points)), distance.argmin(axis=1)
        return face[row, best], weights[row, best], distance[row, best]


def closest_on_triangles(points: Array, corners: Array) -> Array:
    """Barycentric coordinates `(..., 3)` of the closest point of triangles `corners (..., 3, 3)`.

    The foot of the perpendicular where it lies in the triangle, else the best of the three edges.
    """
    a, b, c = (corners[..., k, :] for k in range(3))
    e, f, d = b - a, c - a, points - a
    ee, ef, ff = (e * e).sum(-1), (e * f).sum(-1), (f * f).sum(-1)
    ed, fd = (e * d).sum(-1), (f * d).sum(-1)
    area = ee * ff - ef * ef
    wide = area > 1e-12 * ee * ff  # others are lines
    area = np.where(wide, area, 1.0)
    v, w = (ff * ed - ef * fd) / area, (ee * fd - ef * ed) / area
    inner = np.stack([1 - v - w, v, w], axis=-1)
    best, least = inner, np.where(wide & (inner >= 0).all(axis=-1), 0.0, np.inf)
    for i, j in ((0, 1), (1, 2), (2, 0)):
        p, q = corners[..., i, :], corners[..., j, :]
        along = ((points - p) * (q - p)).sum(-1) / np.maximum(((q - p) ** 2).sum(-1), 1e-300)
        along = np.clip(along, 0, 1)
        edge = np.zeros_like(inner)
        edge[..., i], edge[..., j] = 1 - along, along
        away = np.linalg.norm(p + along[..., None] * (q - p) - points, axis=-1)
        better = away < least
        best, least = np.where(better[..., None], edge, best), np.where(better, away, least)
    return best

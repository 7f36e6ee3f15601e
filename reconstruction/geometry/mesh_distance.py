"""Signed distance to a triangle mesh, closed or open."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from reconstruction.arrays import AnyFloats, Array
from reconstruction.geometry.closest_point import ClosestPoint
from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.mesh_queries import surface_samples
from reconstruction.geometry.strands import unit_or_zero

_SPACING = 5e-3  # of the mesh's extent: of the samples by which faces are found
_AT_A_TIME = 1 << 17


class MeshDistance:
    """Signed distance to `mesh`, metres, negative inside.

    The sign is that of the angle-weighted pseudonormal at the closest point (Bærentzen and Aanæs
    2005). A point that is closest to an open edge is outside: what passes an opening, as of a neck
    or of a scalp alone, does not enter the mesh. `open_edges` is their number.

    Raises `ValueError` if the mesh has no area or adjacent faces with opposite orientations.
    """

    def __init__(self, mesh: Mesh) -> None:
        vertices, index = np.unique(mesh.vertices, axis=0, return_inverse=True)
        faces = index.ravel()[mesh.faces]
        mesh = Mesh(vertices, faces[Mesh(vertices, faces).face_areas() > 0])
        if not len(mesh.faces):
            raise ValueError("the mesh has no area")
        corners, normals = vertices[mesh.faces], mesh.face_normals()
        middle = corners.mean(axis=1)
        weights = mesh.face_areas()[:, None]
        out = weights * normals * (middle - (weights * middle).sum(axis=0) / weights.sum())
        if out.sum() < 0:
            mesh, normals = Mesh(vertices, mesh.faces[:, ::-1]), -normals
            corners = corners[:, ::-1]
        # the edge opposite each corner
        ends = np.stack([np.roll(mesh.faces, -1, 1), np.roll(mesh.faces, -2, 1)], axis=-1)
        if len(np.unique(ends.reshape(-1, 2), axis=0)) < ends[..., 0].size:
            raise ValueError(
                "adjacent faces of the mesh have opposite orientations, or an edge has more than "
                "two faces: recalculate its normals in a mesh editor"
            )
        _, edge, count = np.unique(
            np.sort(ends.reshape(-1, 2), axis=1), axis=0, return_inverse=True, return_counts=True
        )
        edge = edge.ravel()
        open_edge = (count == 1)[edge].reshape(-1, 3)
        self.open_edges = int(open_edge.sum())
        edge_normals = np.zeros((len(count), 3))
        np.add.at(edge_normals, edge, np.repeat(normals, 3, axis=0))
        aside = unit_or_zero((corners[:, [1, 2, 0]] - corners).reshape(-1, 3)).reshape(-1, 3, 3)
        cosine = -np.einsum("fkd,fkd->fk", aside, np.roll(aside, 1, axis=1))
        angle = np.arccos(np.clip(cosine, -1, 1))
        vertex_normals, open_vertex = np.zeros_like(vertices), np.zeros(len(vertices), bool)
        np.add.at(vertex_normals, mesh.faces, angle[..., None] * normals[:, None])
        open_vertex[ends[open_edge]] = True
        # by face: its own normal, those of its edges, those of its corners
        at_edges, at_corners = edge_normals[edge].reshape(-1, 3, 3), vertex_normals[mesh.faces]
        self._normals = np.concatenate([normals[:, None], at_edges, at_corners], axis=1)
        inner = np.zeros((len(normals), 1), bool)
        self._open = np.concatenate([inner, open_edge, open_vertex[mesh.faces]], axis=1)
        self._corners = corners
        self._spacing = 2 * _SPACING * float(np.ptp(vertices, axis=0).max())
        self._closest = ClosestPoint(mesh, self._spacing / 2)
        self._samples, _, face = surface_samples(mesh, self._spacing)
        self._facing, self._tree = normals[face], cKDTree(self._samples)

    def __call__(self, points: AnyFloats) -> tuple[Array, Array]:
        """Distances `(N,)` and unit outward directions `(N, 3)` at `points (N, 3)`.

        Far outside, distances are those to samples of the mesh, at most 1 % of its extent too
        large.
        """
        at = np.asarray(points, np.float64)
        distance, nearest = self._tree.query(at)
        direction = unit_or_zero(at - self._samples[nearest])
        above = np.einsum("nd,nd->n", direction, self._facing[nearest]) > 0.5
        exact = np.flatnonzero(~(above & (distance > self._spacing)))
        for few in np.split(exact, range(_AT_A_TIME, len(exact), _AT_A_TIME)):
            distance[few], direction[few] = self._exact(at[few])
        return distance, direction

    def _exact(self, points: Array) -> tuple[Array, Array]:
        face, weights, distance = self._closest(points)
        zero = weights == 0
        on_edge, at_corner = zero.sum(axis=1) == 1, zero.sum(axis=1) == 2
        feature = np.where(on_edge, 1 + zero.argmax(axis=1), 0)
        feature = np.where(at_corner, 4 + weights.argmax(axis=1), feature)
        normal = unit_or_zero(self._normals[face, feature])
        away = points - np.einsum("nk,nkd->nd", weights, self._corners[face])
        inside = (np.einsum("nd,nd->n", away, normal) < 0) & ~self._open[face, feature]
        signed = np.where(inside, -distance, distance)
        far = distance > 1e-9  # closer, rounding has the direction
        return signed, np.where(far[:, None], unit_or_zero(away) * np.sign(signed)[:, None], normal)

"""A smooth deformation of a posed head mesh towards points.

Displacements of `HANDLES` handles are interpolated; differences of neighbouring handles are
penalised with decreasing stiffness while closest points are updated (Amberg, Romdhani, Vetter:
Optimal Step Nonrigid ICP, 2007, with handles instead of vertices).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from reconstruction.arrays import Array, Bools, Ints
from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.mesh_queries import surface_samples
from reconstruction.head.pose import SurfaceSamples, tukey

_NEAR = 8


HANDLES = 200
STIFFNESS = (10.0, 1.0, 0.1, 0.01)
"""Penalties on differences of neighbouring handles, relative to the mean squared distance."""

ROUNDS = 4  # of nearest points for each stiffness
ANCHOR = 1e-3  # penalty on the displacement itself, which vanishes far from points


@dataclass(frozen=True, eq=False)
class Handles:
    """Handle positions `at (K, 3)` on the undeformed mesh; `reach` of each, metres."""

    at: Array
    reach: float
    links: Ints

    @classmethod
    def on(cls, points: Array, count: int) -> Handles:
        """`count` handles by farthest-point sampling of `points (N, 3)`."""
        chosen = [int(((points - points.mean(axis=0)) ** 2).sum(axis=1).argmax())]
        far = np.full(len(points), np.inf)
        while len(chosen) < min(count, len(points)):
            far = np.minimum(far, ((points - points[chosen[-1]]) ** 2).sum(axis=1))
            chosen.append(int(far.argmax()))
        at = points[chosen]
        distance, near = cKDTree(at).query(at, k=np.arange(2, min(_NEAR, len(at)) + 1))
        pairs = np.stack([np.repeat(np.arange(len(at)), near.shape[1]), near.ravel()], axis=1)
        links = np.unique(np.sort(pairs, axis=1), axis=0)
        return cls(at, 1.5 * float(np.median(distance[:, 0])), links)

    def weights(self, points: Array) -> sparse.csr_array:
        """Share `(N, K)` of each handle in the displacement at `points (N, 3)`; rows sum to 1."""
        k = min(_NEAR, len(self.at))
        distance, near = cKDTree(self.at).query(points, k=np.arange(1, k + 1))
        # relative to the nearest, so that weights never vanish
        w = np.exp(-0.5 * (distance**2 - distance[:, :1] ** 2) / self.reach**2)
        w /= w.sum(axis=1, keepdims=True)
        row = np.repeat(np.arange(len(points)), k)
        return sparse.csr_array((w.ravel(), (row, near.ravel())), shape=(len(points), len(self.at)))


def deform(mesh: Mesh, faces: Bools, points: Array, normals: Array | None, size: float) -> Mesh:
    """The posed `mesh` deformed so that its `faces (F,) bool` lie on `points (N, 3)`.

    `size` is the head's radius in the points' unit.
    """
    places, own, face = surface_samples(mesh, 0.08 * size)
    places, own = places[faces[face]], own[faces[face]]
    handles = Handles.on(mesh.vertices[np.unique(mesh.faces)], HANDLES)
    spread, moves = handles.weights(places), handles.weights(mesh.vertices)
    count = len(handles.at)
    i, j = handles.links.T
    one = np.ones(len(i))
    tie = sparse.coo_array(
        (np.r_[one, one, -one, -one], (np.r_[i, j, i, j], np.r_[i, j, j, i])), shape=(count, count)
    ).toarray() / len(i)
    shift = np.zeros((count, 3))
    for stiffness in STIFFNESS:
        for _ in range(ROUNDS):
            now = places + spread @ shift
            distance, index = SurfaceSamples(now, own).nearest(points, 0.3 * size)
            n = own[index]
            weight = tukey(distance, 0.01 * size)
            if normals is not None:
                weight = weight * ((n * normals).sum(axis=1) > 0.5)
            used = np.flatnonzero(weight)
            if not len(used):
                return mesh
            share = spread[index[used]]
            r = (n[used] * (points[used] - places[index[used]])).sum(axis=1)
            J = sparse.hstack([share * n[used, k : k + 1] for k in range(3)]).tocsr()
            w = weight[used] / weight.sum()
            normal = (J.T @ (J * w[:, None])).toarray()
            hold = np.kron(np.eye(3), stiffness * tie + ANCHOR / count * np.eye(count))
            solved = np.linalg.solve(normal + hold, J.T @ (w * r))
            shift = solved.reshape(3, count).T
    return Mesh(mesh.vertices + moves @ shift, mesh.faces, mesh.scalp)

"""Triangulated points and the head mesh in the pixels of cameras, as evidence for hair masks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from reconstruction.arrays import Array, Bools
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.mesh_queries import depth_map, mesh_depth
from reconstruction.light_planes.point_cloud import PointCloud

STANDS_OFF = 4e-3  # metres: height above the head from which a point is hair


@dataclass(frozen=True, eq=False)
class MaskGeometry:
    """Triangulated points, the head, and the heights `off (N,)` of the points above it, metres."""

    points: PointCloud | None
    head: Mesh | None
    off: Array | None

    @classmethod
    def of(cls, points: PointCloud | None, head: Mesh | None) -> MaskGeometry:
        """With the heights if both are given."""
        if points is None or head is None or not len(points):
            return cls(points, head, None)
        return cls(points, head, distance_to(head, points.points))

    def own(self, camera: Camera) -> Bools:
        """Points that were triangulated in this camera; none if it took no part."""
        assert self.points is not None
        names = self.points.cameras
        return self.points.camera == (names.index(camera.name) if camera.name in names else -1)

    def depth(self, camera: Camera) -> Array:
        """Depth `(H, W)` along z of the camera's own points, else of the head, else 0."""
        out = np.zeros((camera.height, camera.width))
        if self.points is not None:
            out = depth_map(camera, self.points.points[self.own(camera)])
        if self.head is not None:
            depth = mesh_depth(camera, self.head)
            out = np.where((out == 0) & np.isfinite(depth), depth, out)
        return out

    def votes(self, camera: Camera) -> tuple[Array, Array]:
        """Summed weights `(H, W)` of the points off the head and of those on it."""
        size = camera.height, camera.width
        if self.points is None or self.off is None:
            return np.zeros(size), np.zeros(size)
        mine = self.own(camera)
        visible, x, y, _ = camera.pixels_of(self.points.points[mine])
        flat = (y * camera.width + x)[visible]
        weight = self.points.weight[mine][visible]
        standing = self.off[mine][visible] > STANDS_OFF

        def votes(which: Bools) -> Array:
            total: Array = np.bincount(flat[which], weight[which], size[0] * size[1]).astype(float)
            return total.reshape(size)

        return votes(standing), votes(~standing)


def positions(camera: Camera, subject: Bools, geometry: MaskGeometry) -> Array:
    """World positions `(H, W, 3)` of the subject's pixels, NaN where the depth is unknown."""
    depth = geometry.depth(camera)
    y, x = np.nonzero(subject & (depth > 0))
    rays = camera.rays(np.stack([x, y], axis=1))
    out = np.full((*subject.shape, 3), np.nan)
    out[y, x] = camera.center + rays * (depth[y, x] / (rays @ camera.R[2]))[:, None]
    return out


def distance_to(head: Mesh, points: Array) -> Array:
    """Heights `(N,)` of `points (N, 3)` above the surface of `head`, metres, negative inside.

    Measured to samples 2 mm apart, along their normal within 1 cm and as the distance beyond.
    """
    samples, normals = _samples(head, 2e-3)
    distance, index = cKDTree(samples).query(points)
    height = np.einsum("ni,ni->n", points - samples[index], normals[index])
    return np.where(distance < 0.01, height, distance)


def _samples(head: Mesh, step: float) -> tuple[Array, Array]:
    """Points `(N, 3)` about `step` apart on every face of `head`, and their normals `(N, 3)`."""
    corners = head.vertices[head.faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    divisions = np.maximum(np.ceil(longest / step).astype(int), 1)
    normals = head.face_normals()
    points, faces = [], []
    for n in np.unique(divisions):
        of = np.flatnonzero(divisions == n)
        i, j = np.nonzero(np.add.outer(np.arange(n), np.arange(n)) < n)
        u, v = (i + 1 / 3) / n, (j + 1 / 3) / n
        weights = np.stack([1 - u - v, u, v], axis=1)
        points.append(np.einsum("kc,fci->fki", weights, corners[of]).reshape(-1, 3))
        faces.append(np.repeat(of, len(weights)))
    return np.concatenate(points), normals[np.concatenate(faces)]

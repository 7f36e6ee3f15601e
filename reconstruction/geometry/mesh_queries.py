"""Samples, inside test, depth and silhouette of meshes and points."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import AnyFloats, Array, Bools, Ints
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.voxels import VoxelGrid


def surface_samples(mesh: Mesh, spacing: float) -> tuple[Array, Array, Ints]:
    """Points `(M, 3)` on the mesh, evenly spaced at most about `spacing` metres apart.

    Also their smooth unit normals `(M, 3)` (the vertices', interpolated) and faces `(M,)`.
    """
    if not spacing > 0:
        raise ValueError(f"spacing must be positive, got {spacing}")
    corners = mesh.vertices[mesh.faces]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    parts = np.maximum(np.ceil(edges / spacing), 1).astype(int)
    normals = mesh.vertex_normals()[mesh.faces]
    points, directions, faces = [], [], []
    for n in np.unique(parts):
        which = np.flatnonzero(parts == n)
        i, j = (a.ravel() for a in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
        up = i + j < n
        down = i + j < n - 1  # centres of the sub-triangles that stand on their tip
        b = np.concatenate([i[up] + 1 / 3, i[down] + 2 / 3]) / n
        c = np.concatenate([j[up] + 1 / 3, j[down] + 2 / 3]) / n
        weights = np.stack([1 - b - c, b, c], axis=1)
        points.append(np.einsum("sk,fkd->fsd", weights, corners[which]).reshape(-1, 3))
        directions.append(np.einsum("sk,fkd->fsd", weights, normals[which]).reshape(-1, 3))
        faces.append(np.repeat(which, len(weights)))
    n = np.concatenate(directions)
    n /= np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-12)
    return np.concatenate(points), n, np.concatenate(faces)


def inside_mesh(grid: VoxelGrid, mesh: Mesh) -> Bools:
    """Voxels `grid.inside.shape` with their centre in the mesh: most of six ray parities agree.

    The vote tolerates holes: scanned heads are open at the neck and often at the eyes.
    """
    votes = np.zeros(grid.inside.shape, np.int8)
    corners = (mesh.vertices[mesh.faces] - grid.origin) / grid.spacing  # (F, 3, 3), voxels
    # off the lattice, so that no column runs along an edge shared by two faces
    corners = corners + np.array([1.3e-6, 2.1e-6, 1.7e-6])
    for axis in range(3):
        before, total = _crossings(corners, grid.inside.shape, axis)
        votes += (before % 2).astype(np.int8)
        votes += ((total - before) % 2).astype(np.int8)
    return np.asarray(votes >= 4)


def _crossings(
    corners: Array, shape: tuple[int, ...], axis: int
) -> tuple[NDArray[np.int16], NDArray[np.int16]]:
    """Crossings of each column `shape` before each voxel centre, and `total` with axis 1 long."""
    u, v = (a for a in range(3) if a != axis)
    deep = list(shape)
    deep[axis] += 1  # the last layer collects what lies beyond the last centre
    counts = np.zeros(deep, np.int16)
    last = np.array([shape[u] - 1, shape[v] - 1])
    low = np.maximum(np.ceil(corners[:, :, [u, v]].min(axis=1)).astype(int), 0)
    high = np.minimum(np.floor(corners[:, :, [u, v]].max(axis=1)).astype(int), last)
    for f in np.flatnonzero((high >= low).all(axis=1)):
        a, b, c = corners[f]
        area = (b[u] - a[u]) * (c[v] - a[v]) - (b[v] - a[v]) * (c[u] - a[u])
        if area == 0:
            continue
        sides = (np.arange(low[f, k], high[f, k] + 1) for k in (0, 1))
        i, j = (grid.ravel() for grid in np.meshgrid(*sides))
        wb = ((i - a[u]) * (c[v] - a[v]) - (j - a[v]) * (c[u] - a[u])) / area
        wc = ((b[u] - a[u]) * (j - a[v]) - (b[v] - a[v]) * (i - a[u])) / area
        hit = (wb >= 0) & (wc >= 0) & (wb + wc <= 1)
        depth = a[axis] + wb[hit] * (b[axis] - a[axis]) + wc[hit] * (c[axis] - a[axis])
        index = np.empty((3, len(depth)), int)
        index[u], index[v] = i[hit], j[hit]
        index[axis] = np.clip(np.ceil(depth), 0, shape[axis])
        np.add.at(counts, tuple(index), 1)
    total = counts.sum(axis=axis, keepdims=True, dtype=np.int16)
    before = np.cumsum(counts, axis=axis, dtype=np.int16).take(range(shape[axis]), axis=axis)
    return before, total


def depth_map(camera: Camera, points: AnyFloats) -> Array:
    """Depth `(H, W)` along z, metres: the lower median of a pixel's points, 0 without any.

    A pixel has a point per projector that reaches it.
    """
    visible, x, y, depth = camera.pixels_of(points)
    flat, depth = (y * camera.width + x)[visible], depth[visible]
    order = np.lexsort((depth, flat))
    pixel, start, count = np.unique(flat[order], return_index=True, return_counts=True)
    out = np.zeros(camera.height * camera.width)
    out[pixel] = depth[order][start + (count - 1) // 2]
    return out.reshape(camera.height, camera.width)


def nearest_depth(camera: Camera, points: AnyFloats) -> Array:
    """Depth `(H, W)` along z, metres: that of a pixel's nearest point, 0 without any."""
    visible, x, y, depth = camera.pixels_of(points)
    out = np.full((camera.height, camera.width), np.inf)
    np.minimum.at(out, (y[visible], x[visible]), depth[visible])
    return np.where(np.isfinite(out), out, 0.0)


def mesh_depth(camera: Camera, mesh: Mesh) -> Array:
    """Depth `(H, W)` along z of the mesh's nearest surface, infinite off the mesh.

    Painter's algorithm, then the plane of each pixel's face. Faces that reach behind the camera
    are skipped.
    """
    pixels, depth = camera.project(mesh.vertices)
    corners = depth[mesh.faces]
    limit = 30.0 * max(camera.width, camera.height)  # keeps the fixed-point numbers in range
    usable = (corners > 1e-3).all(axis=1) & (np.abs(pixels[mesh.faces]) < limit).all(axis=(1, 2))
    order = np.flatnonzero(usable)
    order = order[np.argsort(-corners[order].mean(axis=1), kind="stable")]
    nearest = np.full((camera.height, camera.width), -1, np.int32)
    shift = 4  # OpenCV's fixed-point bits below the pixel
    triangles = np.rint(pixels[mesh.faces[order]] * (1 << shift)).astype(np.int32)
    for number, triangle in zip(order.tolist(), triangles, strict=True):
        cv2.fillConvexPoly(nearest, triangle, number, lineType=cv2.LINE_8, shift=shift)
    out = np.full(nearest.shape, np.inf)
    y, x = np.nonzero(nearest >= 0)
    face = nearest[y, x]
    rays = camera.rays(np.stack([x, y], axis=1))
    normals, base = mesh.face_normals()[face], mesh.vertices[mesh.faces[face, 0]]
    cosine = np.einsum("nk,nk->n", normals, rays)
    reach = np.einsum("nk,nk->n", normals, base - camera.center)
    along = reach / np.where(np.abs(cosine) > 1e-9, cosine, np.inf) * (rays @ camera.R[2])
    low, high = corners[face].min(axis=1), corners[face].max(axis=1)
    out[y, x] = np.clip(along, low, high)  # an edge's pixel may lie just beside its face
    return out


def mesh_silhouette(camera: Camera, mesh: Mesh) -> Bools:
    """The pixels `(H, W)` that the part of a mesh in front of the camera covers or touches."""
    pixels, depth = camera.project(mesh.vertices)
    faces = mesh.faces[(depth[mesh.faces] > 1e-6).all(axis=1)]
    image = np.zeros((camera.height, camera.width), np.uint8)
    shift = 8  # fillConvexPoly takes fixed-point coordinates with this many fractional bits
    corners = np.rint(np.clip(pixels, -1e5, 1e5) * 2**shift).astype(np.int32)
    for triangle in corners[faces]:
        cv2.fillConvexPoly(image, triangle, 1, lineType=cv2.LINE_8, shift=shift)
    return image.astype(bool)

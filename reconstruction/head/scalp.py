"""The scalp: marked in the mesh, or inferred from the hair's envelope."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from reconstruction.arrays import Array, Bools
from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.mesh_queries import surface_samples
from reconstruction.geometry.voxels import VoxelGrid

_LIFTS = np.arange(1, 7) * 2e-3
"""Metres above the skin that are tested for hair: the envelope may not touch the head."""


class NoScalp(ValueError):
    """No scalp is marked and none can be inferred."""


@dataclass(frozen=True, eq=False)
class Scalp:
    """The part of a head that hair grows from.

    `points (M, 3)` sample it evenly, with outward `normals (M, 3)`; `marked` by the mesh, else
    inferred from the hair's envelope. `share (F,)` is the part of each face that belongs to it.
    """

    head: Mesh
    points: Array
    normals: Array
    share: Array
    marked: bool

    @property
    def area(self) -> float:
        """Square metres."""
        return float(self.head.face_areas() @ self.share)


def find_scalp(head: Mesh, hair: VoxelGrid | None = None, spacing: float = 2e-3) -> Scalp:
    """The scalp of a head, from its mark, or else from the `hair` envelope around it.

    Inferred scalp is surface under the envelope and above the hairline, since hair also covers
    neck, ears and shoulders. The hairline falls from 0.9 half-widths of the head below its top at
    the face (the side with most bare skin) to 2.2 half-widths at the nape.

    Raises `NoScalp`.
    """
    points, normals, faces = surface_samples(head, spacing)
    if head.scalp is not None:
        keep = head.scalp[faces]
    elif hair is None:
        raise NoScalp("the head marks no scalp (a group named 'scalp' in its OBJ)")
    else:
        keep = _under_hair(points, normals, hair)
        keep &= _above_hairline(points, keep)
    if not keep.any():
        raise NoScalp(
            "no part of the head is under hair: check that head.obj and the cameras are in one "
            "frame, or mark the scalp as a group named 'scalp' in the OBJ"
        )
    total = np.bincount(faces, minlength=len(head.faces))
    share = np.bincount(faces, keep, len(head.faces)) / np.maximum(total, 1)
    return Scalp(head, points[keep], normals[keep], share, head.scalp is not None)


def _under_hair(points: Array, normals: Array, hair: VoxelGrid) -> Bools:
    return np.asarray(np.any([hair.contains(points + d * normals) for d in _LIFTS], axis=0))


def _above_hairline(points: Array, covered: Bools) -> Bools:
    top = points[:, 2].max()
    crown = points[points[:, 2] > top - 0.1]
    center = 0.5 * (crown[:, :2].min(axis=0) + crown[:, :2].max(axis=0))
    out = points[:, :2] - center
    radius = np.linalg.norm(out, axis=1)
    width = float(np.percentile(np.linalg.norm(crown[:, :2] - center, axis=1), 90))
    bare = ~covered & (points[:, 2] > top - 2.5 * width)
    face = out[bare].sum(axis=0)
    norm = np.linalg.norm(face)
    face = face / norm if norm > 0 else np.zeros(2)
    ahead = (out @ face) / np.maximum(radius, 1e-9) if norm > 0 else np.full(len(points), -1.0)
    return np.asarray(points[:, 2] > top - width * (1.55 - 0.65 * ahead))


def sample_roots(scalp: Scalp, count: int, seed: int) -> tuple[Array, Array]:
    """`count` roots `(N, 3)` uniform over the scalp's area, and their normals `(N, 3)`.

    Faces are drawn by their scalp area; on partial scalp faces, roots are redrawn until near a
    scalp point.
    """
    if count < 1:
        raise ValueError(f"the number of roots must be positive, got {count}")
    rng = np.random.default_rng(seed)
    head = scalp.head
    weight = head.face_areas() * (scalp.share > 0)
    corners, normals = head.vertices[head.faces], head.vertex_normals()[head.faces]
    tree = cKDTree(scalp.points)
    points, directions = np.zeros((0, 3)), np.zeros((0, 3))
    while len(points) < count:
        face = rng.choice(len(weight), 2 * count, p=weight / weight.sum())
        r, s = rng.random((2, len(face)))
        fold = r + s > 1
        r, s = np.where(fold, 1 - r, r), np.where(fold, 1 - s, s)
        bary = np.stack([1 - r - s, r, s], axis=1)
        p = np.einsum("nk,nkd->nd", bary, corners[face])
        n = np.einsum("nk,nkd->nd", bary, normals[face])
        keep = scalp.share[face] >= 1
        keep[~keep] = tree.query(p[~keep])[0] < 2.5e-3
        points = np.concatenate([points, p[keep]])
        directions = np.concatenate([directions, n[keep]])
    n = directions[:count]
    return points[:count], n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-12)

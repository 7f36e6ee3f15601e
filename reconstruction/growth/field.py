"""Orientation fields: measured tangents spread through the hair's volume (Photobooth §3.3)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse.csgraph import connected_components

from reconstruction.arrays import AnyFloats, Array, Bools, Floats, Ints
from reconstruction.geometry.voxels import VoxelGrid
from reconstruction.growth.laplace import conjugate_gradients, grid_laplacian
from reconstruction.report.report import Series
from reconstruction.tangents.estimate import Measured

_PAD = 2
_ROWS, _COLUMNS = np.array([0, 1, 2, 0, 0, 1]), np.array([0, 1, 2, 1, 2, 2])


def to_tensors(directions: AnyFloats) -> Array:
    """Structure tensors `(N, 6)` (xx, yy, zz, xy, xz, yz) of lines along `directions (N, 3)`.

    `t tᵀ / |t|²`: the same for t and -t, trace 1.
    """
    t = np.asarray(directions, float)
    norm = np.linalg.norm(t, axis=1, keepdims=True)
    if (norm == 0).any():
        raise ValueError("directions must not be zero")
    t = t / norm
    return np.asarray(t[:, _ROWS] * t[:, _COLUMNS])


def principal(tensors: Array) -> tuple[Array, Array]:
    """Unit eigenvectors `(N, 3)` of the largest eigenvalue, and eigenvalues `(N, 3)`, descending.

    `tensors (N, 6)` as of `to_tensors`.
    """
    full = np.empty((len(tensors), 3, 3))
    full[:, _ROWS, _COLUMNS] = tensors
    full[:, _COLUMNS, _ROWS] = tensors
    values, vectors = np.linalg.eigh(full)
    return vectors[:, :, 2], values[:, ::-1]


@dataclass(frozen=True, eq=False)
class OrientationField:
    """Undirected orientations on the voxels of an envelope.

    `grid` marks the envelope; its M inside voxels in C order carry `tensors (M, 6)`,
    `directions (M, 3)` (unit, sign meaningless; 0 where `valid` is False), `coherence (M,)`
    (largest minus second eigenvalue, 0 to 1), `measured (M,)` (a measurement fell into the voxel),
    `empty (M,)` (part of a connected piece without any data) and `degenerate (M,)` (the two largest
    eigenvalues nearly agree: there is no orientation).
    """

    grid: VoxelGrid
    tensors: Array
    directions: Array
    coherence: Array
    measured: Bools
    empty: Bools
    degenerate: Bools

    # padded by two voxels that map to the row of zeros after the last voxel: no bounds checks
    @cached_property
    def _padded(self) -> NDArray[np.int32]:
        count = len(self.directions)
        padded = np.full(np.array(self.grid.inside.shape) + 2 * _PAD, count, np.int32)
        padded[_PAD:-_PAD, _PAD:-_PAD, _PAD:-_PAD][self.grid.inside] = np.arange(count)
        return padded

    @cached_property
    def _table(self) -> Floats:
        return np.concatenate([self.directions, np.zeros((1, 3))]).astype(np.float32)

    @cached_property
    def _strides(self) -> Ints:
        _, rows, columns = self._padded.shape
        return np.array([rows * columns, columns, 1])

    @property
    def valid(self) -> Bools:
        """Voxels `(M,)` with an orientation."""
        return np.asarray(~(self.empty | self.degenerate))

    def near_measured(self, reach: float) -> Bools:
        """Voxels `(M,)` within `reach` metres, centre to centre, of a measured one."""
        measured = np.zeros(self.grid.inside.shape, bool)
        measured[self.grid.inside] = self.measured
        if not measured.any():
            return np.zeros(len(self.directions), bool)
        away = ndimage.distance_transform_edt(~measured, sampling=self.grid.spacing)
        return np.asarray(away[self.grid.inside] <= reach)

    def voxel(self, points: AnyFloats) -> Ints:
        """The number `(N,)` of the envelope voxel that holds each point, -1 outside."""
        number = self._padded.ravel()[self._flat(self.grid.index(points))]
        return np.where(number == len(self.directions), -1, number).astype(np.int64)

    def sample(self, points: AnyFloats, along: Array) -> tuple[Array, Bools]:
        """Directions `(N, 3)` at `points (N, 3)`, signed to agree with `along (N, 3)`.

        Trilinear over the voxels that have an orientation, signs aligned first. Also where there
        is any such voxel `(N,)`.
        """
        q = (points - self.grid.origin) / self.grid.spacing
        base = np.floor(q)
        high = (q - base).astype(np.float32)
        low = 1 - high
        flat = self._flat(base.astype(np.int64))
        corners = np.array(list(np.ndindex(2, 2, 2))) @ self._strides
        d = self._table[self._padded.ravel()[flat[:, None] + corners]]
        # (N, 8) in the order of `ndindex`: the last axis of the grid runs fastest
        x, y, z = (np.stack([low[:, k], high[:, k]], axis=1) for k in range(3))
        weight = (x[:, :, None, None] * y[:, None, :, None] * z[:, None, None, :]).reshape(-1, 8)
        turned = np.einsum("nkd,nd->nk", d, along.astype(np.float32)) < 0
        total = np.einsum("nk,nkd->nd", np.where(turned, -weight, weight), d).astype(float)
        norm = np.sqrt(np.einsum("nd,nd->n", total, total))
        good = norm > 1e-6
        return np.where(good[:, None], total / np.where(good, norm, 1.0)[:, None], 0.0), good

    def _flat(self, index: Ints) -> Ints:
        """Flat indices `(N,)` into the padded volume; voxels off the grid fall on its rim."""
        inside = np.clip(index + _PAD, 0, np.array(self._padded.shape) - 2)
        return np.asarray(inside @ self._strides)


LEAST_COHERENCE = 0.5
"""Difference of the two largest eigenvalues under which a voxel counts as degenerate."""


DOWN = np.array([0.0, 0.0, -1.0])


def descent(grid: VoxelGrid, head: Bools | None = None) -> tuple[Array, Array]:
    """Centres `(N, 3)` of the outer surface's voxels and unit directions `(N, 3)` of descent.

    The steepest descent within the surface is the prior for unmeasured hair. Voxels that touch the
    `head`'s inside `(X, Y, Z)` are no outer surface.
    """
    solid = np.pad(grid.inside if head is None else grid.inside | head, 4)
    surface = solid & ~ndimage.binary_erosion(solid)
    smooth = ndimage.gaussian_filter(solid.astype(np.float32), 2.0)
    index = np.argwhere(surface[4:-4, 4:-4, 4:-4] & grid.inside)
    normal = -np.stack([g[tuple(index.T + 4)] for g in np.gradient(smooth)], axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    tangent = DOWN - (normal @ DOWN)[:, None] * normal
    steepness = np.linalg.norm(tangent, axis=1)
    keep = steepness > 0.1  # below 6 degrees the descent is voxel noise
    return grid.centers(index[keep]), tangent[keep] / steepness[keep, None]


DESCENT_WEIGHT = 0.3
"""Confidence of the descent prior, beside that of measured lines in the same voxel (0 to 1)."""


def with_descent(grid: VoxelGrid, measured: Measured, head: Bools) -> Measured:
    """The measured lines and, all over the outer surface, the `descent` prior."""
    points, directions = descent(grid, head)
    return Measured(
        np.concatenate([measured.points, points]),
        np.concatenate([measured.directions, directions]),
        np.concatenate([measured.confidence, np.full(len(points), DESCENT_WEIGHT)]),
    )


def gather(
    grid: VoxelGrid, points: AnyFloats, directions: AnyFloats, weights: AnyFloats
) -> tuple[Ints, Array, Array]:
    """Data per voxel: numbers `(D,)` of the voxels hit, mean tensors `(D, 6)`, weights `(D,)`.

    Points outside the envelope go to the nearest of the 26 neighbours inside, or are dropped.
    """
    number = np.full(grid.inside.shape, -1, np.int64)
    number[grid.inside] = np.arange(int(grid.inside.sum()))
    index = grid.index(points)
    q = (np.asarray(points, float) - grid.origin) / grid.spacing

    def numbered(ijk: Ints) -> Ints:
        on: Bools = np.asarray(((ijk >= 0) & (ijk < np.array(number.shape))).all(axis=1))
        return np.where(on, number[tuple(np.where(on[:, None], ijk, 0).T)], -1)

    best = numbered(index)
    off = np.flatnonzero(best < 0)
    distance = np.full(len(off), np.inf)
    for shift in np.ndindex(3, 3, 3):
        moved = index[off] + np.array(shift) - 1
        n, far = numbered(moved), np.linalg.norm(q[off] - moved, axis=1)
        nearer = (n >= 0) & (far < distance)
        best[off[nearer]], distance[nearer] = n[nearer], far[nearer]
    ok = (best >= 0) & (np.asarray(weights) > 0)
    voxels, member = np.unique(best[ok], return_inverse=True)
    w = np.asarray(weights, float)[ok]
    tensors = to_tensors(np.asarray(directions)[ok]) * w[:, None]
    total = np.bincount(member, w, len(voxels)).astype(float)
    sums = np.stack([np.bincount(member, t, len(voxels)) for t in tensors.T], axis=1)
    return voxels, sums / np.maximum(total, 1e-300)[:, None], total


def solve_field(
    grid: VoxelGrid,
    points: AnyFloats,
    directions: AnyFloats,
    weights: AnyFloats | None = None,
    tolerance: float = 1e-4,
) -> tuple[OrientationField, Series | None]:
    """Spread measured lines through the envelope: Laplace's equation for each tensor entry.

    The steady state of Photobooth Eq. 3: Dirichlet data at `points (N, 3)` with `directions (N, 3)`
    and `weights (N,)`, no flux through the envelope's surface, solved to a relative residual of
    `tolerance`. Unlike the paper, the scalp's normals are no boundary condition: hair that lies
    flat on the head would turn. Also returns error against run time, None without unknowns.

    Raises `ValueError` for an empty envelope or without data inside.
    """
    system = field_system(grid, points, directions, weights)
    values, free = system.values.copy(), system.free
    series = None
    if len(free):
        values[free], series = conjugate_gradients(*system.equations(), tolerance)
    directions_, eigenvalues = principal(values)
    coherence = eigenvalues[:, 0] - eigenvalues[:, 1]
    degenerate = ~system.empty & (coherence < LEAST_COHERENCE)
    directions_[system.empty | degenerate] = 0
    field = OrientationField(
        grid, values, directions_, coherence, system.measured, system.empty, degenerate
    )
    return field, series


@dataclass(frozen=True, eq=False)
class FieldSystem:
    """What `solve_field` solves, on the M voxels of the envelope.

    `values (M, 6)` are tensors, 0 where not `measured (M,)`; `empty (M,)` as in the field; `free
    (F,)` numbers the unknowns.
    """

    laplacian: sparse.csr_array
    values: Array
    measured: Bools
    empty: Bools

    @property
    def free(self) -> Ints:
        """Numbers `(F,)` of the voxels to solve for."""
        return np.flatnonzero(~self.measured & ~self.empty)

    def equations(self) -> tuple[sparse.csr_array, Array, Array]:
        """`A (F, F)`, `b (F, 6)` and a start `(F, 6)`: the mean of the data, so of trace 1."""
        rows = self.laplacian[self.free]
        known = np.flatnonzero(self.measured)
        b = -(rows[:, known] @ self.values[known])
        return rows[:, self.free], b, np.broadcast_to(self.values[known].mean(axis=0), b.shape)


def field_system(
    grid: VoxelGrid, points: AnyFloats, directions: AnyFloats, weights: AnyFloats | None = None
) -> FieldSystem:
    """The linear system of `solve_field`, with the same arguments and errors."""
    count = int(grid.inside.sum())
    if count == 0:
        raise ValueError("the hair's envelope is empty: check masks and poses")
    weights = np.ones(len(points)) if weights is None else weights
    voxels, data, _ = gather(grid, points, directions, weights)
    measured = np.zeros(count, bool)
    measured[voxels] = True
    values = np.zeros((count, 6))
    values[voxels] = data
    if not measured.any():
        raise ValueError("no orientation was measured inside the hair's envelope")
    laplacian = grid_laplacian(grid.inside)
    pieces, piece = connected_components(laplacian, directed=False)
    has_data = np.zeros(pieces, bool)
    has_data[piece[measured]] = True
    return FieldSystem(laplacian, values, measured, ~has_data[piece])

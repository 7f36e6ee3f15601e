"""Laplace's equation on the voxels of a volume: multigrid-preconditioned conjugate gradients."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from itertools import islice

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from reconstruction.arrays import Array, Bools
from reconstruction.report.report import Series

_COARSEST = 3000
_OVERCORRECTION = 1.8
"""Constant interpolation over 2x2x2 blocks makes the coarse operator up to twice too stiff."""


def grid_laplacian(inside: Bools) -> sparse.csr_array:
    """The graph Laplacian `(M, M)` of the M marked voxels of `inside`, C order, six neighbours.

    Symmetric, rows sum to 0: no flux passes the volume's surface. Its unit is 1 / spacing².
    """
    number = np.full(inside.shape, -1, np.int64)
    count = int(inside.sum())
    number[inside] = np.arange(count)
    pairs = []
    for axis in range(3):
        a = number.take(range(inside.shape[axis] - 1), axis=axis).ravel()
        b = number.take(range(1, inside.shape[axis]), axis=axis).ravel()
        both = (a >= 0) & (b >= 0)
        pairs.append(np.stack([a[both], b[both]]))
    i, j = np.concatenate(pairs, axis=1)
    one = np.ones(len(i))
    off = sparse.coo_array((np.r_[one, one], (np.r_[i, j], np.r_[j, i])), shape=(count, count))
    degree = off.sum(axis=1)
    return sparse.csr_array(sparse.diags_array(degree) - off)


class Multigrid:
    """One symmetric V-cycle for a symmetric positive definite matrix, as a preconditioner.

    Algebraic: three pairwise matchings a level along the strongest couplings, weighted Jacobi.
    """

    def __init__(self, A: sparse.csr_array) -> None:
        self.levels: list[tuple[sparse.csr_array, Array, sparse.csr_array]] = []
        while A.shape[0] > _COARSEST:
            P = _aggregate(A)
            if P.shape[1] > 0.8 * A.shape[0]:
                break
            self.levels.append((A, _jacobi(A), P))
            A = sparse.csr_array(P.T @ A @ P)
        self.coarsest = splu(sparse.csc_matrix(A)) if A.shape[0] <= 8 * _COARSEST else None
        self.last = (A, _jacobi(A))

    def __call__(self, r: Array) -> Array:
        """Approximately `A⁻¹ r` for `r (M, K)`."""
        return self._cycle(0, r)

    def _cycle(self, depth: int, r: Array) -> Array:
        if depth == len(self.levels):
            if self.coarsest is not None:
                return np.asarray(self.coarsest.solve(r))
            return self.last[1][:, None] * r
        A, jacobi, P = self.levels[depth]
        x = jacobi[:, None] * r
        x += _OVERCORRECTION * (P @ self._cycle(depth + 1, P.T @ (r - A @ x)))
        x += jacobi[:, None] * (r - A @ x)
        return x


def _jacobi(A: sparse.csr_array) -> Array:
    return 0.7 / np.asarray(A.diagonal())


def _aggregate(A: sparse.csr_array) -> sparse.csr_array:
    """Interpolation `(M, m)` that is constant on blocks of up to eight matched unknowns."""
    P = sparse.csr_array(sparse.eye_array(A.shape[0]))
    for _ in range(3):
        coarse = sparse.csr_array(P.T @ A @ P)
        P = sparse.csr_array(P @ _match(coarse))
    return P


def _match(A: sparse.csr_array) -> sparse.csr_array:
    """Pairs of mutually strongest neighbours, found in a few rounds; the rest stay single."""
    n = A.shape[0]
    off = sparse.coo_array(A)
    keep = off.row != off.col
    row, col, weight = off.row[keep], off.col[keep], -off.data[keep]
    # a fixed pseudo-random share breaks ties
    low, high = np.minimum(row, col).astype(np.uint64), np.maximum(row, col).astype(np.uint64)
    mixed = (low * np.uint64(0x9E3779B97F4A7C15) ^ high * np.uint64(0xC2B2AE3D27D4EB4F)) >> 40
    weight = weight * (1 + 1e-3 * mixed.astype(float) / 2**24)
    partner = np.full(n, -1)
    for _ in range(6):
        live = (partner[row] < 0) & (partner[col] < 0)
        row, col, weight = row[live], col[live], weight[live]
        if not len(row):
            break
        best = np.zeros(n)
        np.maximum.at(best, row, weight)
        chosen = (weight == best[row]) & (weight == best[col])
        partner[row[chosen]] = col[chosen]
    index = np.arange(n)
    leader = np.where((partner >= 0) & (partner < index), partner, index)
    _, block = np.unique(leader, return_inverse=True)
    return sparse.csr_array((np.ones(n), (index, block)), shape=(n, int(block.max()) + 1))


def conjugate_gradient_steps(
    A: sparse.csr_array, b: Array, start: Array, precondition: Callable[[Array], Array]
) -> Iterator[tuple[Array, Array]]:
    """Iterates x of `A x = b` and their residuals, `start` first, for all columns of `b (M, K)`.

    A is symmetric positive definite. The arrays are the iteration's own: they change at the next.
    """
    x = np.array(start, dtype=float)
    r = b - A @ x
    z = precondition(r)
    p = z.copy()
    rz = (r * z).sum(axis=0)
    while True:
        yield x, r
        q = A @ p
        alpha = rz / np.maximum((p * q).sum(axis=0), 1e-300)
        x += alpha * p
        r -= alpha * q
        z = precondition(r)
        before, rz = rz, (r * z).sum(axis=0)
        p = z + (rz / np.maximum(before, 1e-300)) * p


def conjugate_gradients(
    A: sparse.csr_array, b: Array, start: Array, tolerance: float = 1e-6, limit: int = 500
) -> tuple[Array, Series]:
    """Solve `A x = b` for all columns of `b (M, K)` at once; A symmetric positive definite.

    Stops when every column's residual is under `tolerance` times its right-hand side's norm.
    Returns x and the relative residual against run time. Raises `RuntimeError` after `limit`
    iterations.
    """
    begin = time.perf_counter()
    series = Series("multigrid conjugate gradients", "relative residual")
    scale = np.maximum(np.linalg.norm(b, axis=0), 1e-12)
    steps = conjugate_gradient_steps(A, b, start, Multigrid(A))
    for x, r in islice(steps, limit):
        error = float((np.linalg.norm(r, axis=0) / scale).max())
        series.points.append((time.perf_counter() - begin, error))
        if error <= tolerance:
            return x, series
    raise RuntimeError(
        f"conjugate gradients stopped at a residual of {error:.2g} after {limit} iterations, "
        f"wanted {tolerance:.2g}"
    )

"""Least squares with the covariance that says what the data left open."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse

from reconstruction.arrays import Array

Linearised = Callable[[Array], tuple[Array, Any]]
"""Residuals `(m,)` and their derivatives `(m, n)`, dense or sparse."""


@dataclass(frozen=True, eq=False)
class Solution:
    """Parameters `x (n,)` with their `covariance (n, n)`, and the residuals `(m,)` there.

    `conditioning` is the smallest eigenvalue over the mean one of the normal matrix with unit
    diagonal, 0 where the data leaves a direction open; `weakest (n,)` is that direction, in units
    of the parameters. The covariance is not finite along it then.
    """

    x: Array
    residual: Array
    covariance: Array
    conditioning: float
    weakest: Array

    @property
    def deviation(self) -> Array:
        """Standard deviations `(n,)` of the parameters."""
        return np.sqrt(np.diag(self.covariance))


OPEN = 1e-12
"""A conditioning below which a direction counts as open."""


def minimise(function: Linearised, x: Array, *, huber: float = 3.0, steps: int = 100) -> Solution:
    """Minimise residuals in units of their standard deviation, by Levenberg and Marquardt.

    `function(x)` returns the residuals `(m,)` and their derivatives `(m, n)`. Residuals beyond
    `huber` deviations count linearly. The covariance grows with the residuals where they are larger
    than their deviations promised, and never shrinks.
    """
    x = np.array(x, dtype=np.float64)
    r, J = function(x)
    damping = 1e-3
    for _ in range(steps):
        A, g = _normal(r, J, huber)
        scale = np.sqrt(np.maximum(np.diag(A), np.finfo(float).tiny))
        scale[scale < 1e-12 * scale.max(initial=0)] = 1.0
        A, g = A / np.outer(scale, scale), g / scale
        cost, better = _cost(r, huber), False
        while damping < 1e12 and not better:
            change = np.linalg.solve(A + damping * np.eye(len(x)), -g)
            with np.errstate(all="ignore"):  # a wild step is refused below
                r_new, J_new = function(x + change / scale)
            new = _cost(r_new, huber)
            better = bool(np.isfinite(new) and new < cost)
            damping *= 0.1 if better else 10.0
        if not better:
            break
        x, r, J = x + change / scale, r_new, J_new
        damping = max(damping, 1e-12)
        if cost - new <= 1e-12 * cost:
            break
    return _solution(x, r, J, huber)


def numeric(residual: Callable[[Array], Array], step: float = 1e-6) -> Linearised:
    """`residual` with its derivatives by central differences of `step`."""

    def function(x: Array) -> tuple[Array, Array]:
        sides = [[residual(x + s * d) for s in (1, -1)] for d in step * np.eye(len(x))]
        columns = [(ahead - behind) / (2 * step) for ahead, behind in sides]
        return residual(x), np.stack(columns, axis=1)

    return function


def _weights(r: Array, huber: float) -> Array:
    return np.minimum(1.0, huber / np.maximum(np.abs(r), huber))


def _cost(r: Array, huber: float) -> float:
    a = np.abs(r)
    return float(np.where(a <= huber, 0.5 * a * a, huber * (a - 0.5 * huber)).sum())


def _normal(r: Array, J: Any, huber: float) -> tuple[Array, Array]:
    weights = _weights(r, huber)
    A = J.T @ (sparse.diags_array(weights) @ J)
    return (A.toarray() if sparse.issparse(A) else np.asarray(A)), J.T @ (weights * r)


def _solution(x: Array, r: Array, J: Any, huber: float) -> Solution:
    A, _ = _normal(r, J, huber)
    diagonal = np.sqrt(np.diag(A))
    seen = diagonal > 0
    scale = np.where(seen, diagonal, 1.0)
    values, vectors = np.linalg.eigh(A / np.outer(scale, scale))
    conditioning = max(float(values[0]), 0.0) / max(float(values.mean()), np.finfo(float).tiny)
    with np.errstate(divide="ignore"):
        inverse = np.where(values > OPEN * len(x), 1 / np.maximum(values, 1e-300), 1e30)
    freedom = max(len(r) - len(x), 1)
    spread = max(1.0, 2 * _cost(r, huber) / freedom)
    covariance = spread * (vectors * inverse) @ vectors.T / np.outer(scale, scale)
    return Solution(x, r, covariance, conditioning, vectors[:, 0] / scale)

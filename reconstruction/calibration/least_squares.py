"""Least squares with a covariance that shows undetermined directions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse
from scipy.optimize import least_squares

from reconstruction.arrays import Array

Linearised = Callable[[Array], tuple[Array, Any]]
"""Residuals `(M,)` and their derivatives `(M, N)`, dense or sparse."""


@dataclass(frozen=True, eq=False)
class Solution:
    """Parameters `x (N,)` with their `covariance (N, N)`, and the residuals `(M,)` there.

    `conditioning` is the smallest eigenvalue over the mean one of the normal matrix with unit
    diagonal, 0 for an undetermined direction, along which the covariance is huge; `weakest (N,)` is
    that direction in units of the parameters.
    """

    x: Array
    residual: Array
    covariance: Array
    conditioning: float
    weakest: Array

    @property
    def deviation(self) -> Array:
        """Standard deviations `(N,)` of the parameters."""
        return np.sqrt(np.diag(self.covariance))


OPEN = 1e-12  # conditioning below which a direction is undetermined


def minimise(function: Linearised, x: Array, *, huber: float = 3.0) -> Solution:
    """Minimise residuals in units of their standard deviation, by a trust region method.

    `function(x)` of `x (N,)` returns the residuals `(M,)` and their derivatives `(M, N)`. Residuals
    beyond `huber` deviations count linearly. The covariance is scaled up if the residuals exceed
    their deviations, never down.
    """
    x = np.array(x, dtype=np.float64)
    last: dict[bytes, tuple[Array, Any]] = {}

    def at(x: Array) -> tuple[Array, Any]:
        if (key := x.tobytes()) not in last:
            last.clear()
            with np.errstate(all="ignore"):  # such a step is rejected
                last[key] = function(x)
        return last[key]

    limits: dict[str, Any] = {"ftol": 1e-12, "xtol": 1e-12, "gtol": 1e-12, "max_nfev": 200}
    if sparse.issparse(at(x)[1]):
        limits["tr_options"] = {"atol": 1e-12, "btol": 1e-12}
    scaled = {"x_scale": "jac", "loss": "huber", "f_scale": huber}
    found = least_squares(lambda x: at(x)[0], x, jac=lambda x: at(x)[1], **scaled, **limits)
    return _solution(found.x, *at(found.x), huber)


def numeric(residual: Callable[[Array], Array], step: float = 1e-6) -> Linearised:
    """`residual (M,)` with its derivatives `(M, N)` by central differences of `step`."""

    def function(x: Array) -> tuple[Array, Array]:
        sides = [[residual(x + s * d) for s in (1, -1)] for d in step * np.eye(len(x))]
        columns = [(ahead - behind) / (2 * step) for ahead, behind in sides]
        return residual(x), np.stack(columns, axis=1)

    return function


def _solution(x: Array, r: Array, J: Any, huber: float) -> Solution:
    weights = np.minimum(1.0, huber / np.maximum(np.abs(r), huber))
    A = J.T @ (sparse.diags_array(weights) @ J)
    A = A.toarray() if sparse.issparse(A) else A
    diagonal = np.sqrt(np.diag(A))
    observed = diagonal > 0
    scale = np.where(observed, diagonal, 1.0)
    values, vectors = np.linalg.eigh(A / np.outer(scale, scale))
    conditioning = max(float(values[0]), 0.0) / max(float(values.mean()), np.finfo(float).tiny)
    with np.errstate(divide="ignore"):
        inverse = np.where(values > OPEN * len(x), 1 / np.maximum(values, 1e-300), 1e30)
    freedom = max(len(r) - len(x), 1)
    spread = max(1.0, float((weights * (2 - weights) * r * r).sum()) / freedom)
    covariance = spread * (vectors * inverse) @ vectors.T / np.outer(scale, scale)
    return Solution(x, r, covariance, conditioning, vectors[:, 0] / scale)

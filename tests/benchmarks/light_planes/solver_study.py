"""How far each way to solve the field's equations is from their solution, against run time."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np
from scipy import sparse

from reconstruction.arrays import Array
from reconstruction.growth.laplace import (
    Multigrid,
    conjugate_gradient_steps,
    conjugate_gradients,
)
from reconstruction.report.report import Series


def explicit_steps(A: sparse.csr_array, b: Array, start: Array) -> Iterator[tuple[Array, Array]]:
    """The heat equation's explicit steps, Δt = h²/6: iterates and residuals `(F, 6)`."""
    x = np.array(start, dtype=float)
    while True:
        r = b - A @ x
        yield x, r
        x += r / 6


def compare_solvers(
    A: sparse.csr_array, b: Array, start: Array, *, seconds: float = 60.0, error: float = 1e-6
) -> list[Series]:
    """Distance from the fixed point, against run time, of each way to solve `A x = b (M, K)`.

    Explicit steps, conjugate gradients preconditioned by the diagonal, and by multigrid (by itself
    the V-cycle overcorrects, so it is no solver). The fixed point is the last one's at a relative
    residual of 1e-13; the distance the largest of all entries. A curve ends under `error`, or after
    `seconds`; setting multigrid up is part of its time, measuring the distance is not.
    """
    truth, _ = conjugate_gradients(A, b, start, 1e-13)
    diagonal = np.asarray(A.diagonal())[:, None]
    ways: dict[str, Callable[[], Iterator[tuple[Array, Array]]]] = {
        "explicit steps": lambda: explicit_steps(A, b, start),
        "conjugate gradients": lambda: conjugate_gradient_steps(
            A, b, start, lambda r: r / diagonal
        ),
        "multigrid conjugate gradients": lambda: conjugate_gradient_steps(
            A, b, start, Multigrid(A)
        ),
    }
    out = []
    for name, steps in ways.items():
        series, spent = Series(name, "distance from the fixed point"), 0.0
        begin = time.perf_counter()
        for step, (x, _) in enumerate(steps()):
            spent += time.perf_counter() - begin
            stride = max(step // 50, 1)  # thousands of explicit steps need no thousand points
            if step % stride == 0:
                series.points.append((spent, float(np.abs(x - truth).max(initial=0))))
                if series.points[-1][1] < error or spent > seconds:
                    break
            begin = time.perf_counter()
        out.append(series)
    return out

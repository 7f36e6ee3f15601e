"""How far a growth method strays from the field's own lines, against what it costs."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from reconstruction.arrays import AnyFloats
from reconstruction.growth.field import OrientationField
from reconstruction.growth.from_roots import Method, Tracing, trace
from reconstruction.report.report import Series

METHODS: tuple[Method, ...] = ("euler", "midpoint", "rk4")
COST: dict[Method, int] = {"euler": 1, "midpoint": 2, "rk4": 4}
"""Looks into the field per step."""


def compare_growth(
    field: OrientationField,
    starts: AnyFloats,
    along: AnyFloats,
    *,
    steps: Sequence[float] = (4e-3, 2e-3, 1e-3, 5e-4, 2.5e-4),
    max_length: float = 0.1,
    finer: int = 16,
    quantile: float = 0.5,
) -> list[Series]:
    """Error against run time of each method, from the longest step to the shortest.

    Paths set out as in `trace`. `steps` are powers of two times the shortest, metres; the truth is
    Runge and Kutta's at a `finer`th of that. A path's error is the mean distance, metres, of its
    points from the truth's at the same arc length, as far as both go; a curve shows the `quantile`
    over all paths that go anywhere. Run times are the least of three.
    """
    shortest = min(steps)
    often = [round(step / shortest) for step in steps]
    if not np.allclose(np.array(often) * shortest, steps):
        raise ValueError(f"every step must be a multiple of the shortest, got {list(steps)}")
    truth = trace(field, starts, along, Tracing(shortest / finer, max_length, "rk4"))
    out = []
    for method in METHODS:
        series = Series(method, "distance from the field's line, m")
        for step, stride in zip(steps, often, strict=True):
            seconds = np.inf
            for _ in range(3):
                begin = time.perf_counter()
                paths = trace(field, starts, along, Tracing(step, max_length, method))
                seconds = min(seconds, time.perf_counter() - begin)
            errors = []
            for path, line in zip(paths, truth, strict=True):
                there = line[:: stride * finer]
                if (n := min(len(path), len(there))) > 1:
                    off = np.linalg.norm(path[:n].astype(float) - there[:n], axis=1)
                    errors.append(off.sum() / (n - 1))
            if errors:
                series.points.append((seconds, float(np.quantile(errors, quantile))))
        out.append(series)
    return out

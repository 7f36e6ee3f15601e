"""Parts of a view's hair: sums over each, and jackknife errors over them."""

from __future__ import annotations

import numpy as np

from appearance.observations import Observed
from reconstruction.arrays import Array, Ints

SIDE = 3
"""A view's hair is divided into 3 × 3 parts."""
FEWEST_PAIRS = 200
"""Fewest pairs of lights, over all pixels, for an estimate."""
FEWEST_OF_VIEW = 1000
"""Fewest pairs of lights of a single view whose estimate is compared with others'."""


def parts_of(observed: Observed) -> Ints:
    """Part of the view's hair `(P,)` that each pixel lies in: thirds by column, thirds of those."""
    row, column = np.divmod(observed.pixels, observed.camera.width)
    out = np.zeros(len(row), np.int64)
    for i, third in enumerate(np.array_split(np.argsort(column, kind="stable"), SIDE)):
        for j, part in enumerate(
            np.array_split(third[np.argsort(row[third], kind="stable")], SIDE)
        ):
            out[part] = SIDE * i + j
    return out


def bin_of(values: Array, edges: Array) -> Ints:
    """Which of the bins between `edges (B + 1,)` each of `values (N,)` lies in, or is nearest."""
    return np.clip(np.digitize(values, edges) - 1, 0, len(edges) - 2)


def summed(place: Ints, values: Array, shape: tuple[int, ...]) -> Array:
    """Sums of `values (N,)` by their flat `place (N,)` in an array of `shape`."""
    return np.asarray(np.bincount(place, values, int(np.prod(shape))).reshape(shape), float)


def leaving_out(pairs: Array) -> tuple[Array, int]:
    """Weights `(M, J)` of parts that have `pairs (J,)`: all, all but one, and single views; and the
    number of those that leave one out."""
    parts = len(pairs)
    left_out = (1 - np.eye(parts))[pairs > 0]
    views = np.kron(np.eye(parts // SIDE**2), np.ones(SIDE**2))
    views = views[views @ pairs >= FEWEST_OF_VIEW]
    return np.concatenate([np.ones((1, parts)), left_out, views]), len(left_out)


def errors(estimates: Array, parts: int) -> tuple[float, float]:
    """Standard errors of the first of `estimates (N,)`: the jackknife's, and between views.

    The next `parts` of them leave out a part of the hair each; the rest are those of single views.
    """
    left_out, alone = estimates[1 : parts + 1], estimates[parts + 1 :]
    between = alone.std(ddof=1) / np.sqrt(len(alone)) if len(alone) > 1 else 0.0
    return float(np.sqrt((parts - 1) * left_out.var())), float(between)

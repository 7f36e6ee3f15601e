"""Averages of scores over neighbouring points, in the radius that the capture supports."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from reconstruction.arrays import AnyFloats, Array, Floats, Ints

RADII = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
"""Radii that are compared, in spacings of the points."""

WEIGHTS = (0.0, 0.15, 0.3, 0.5, 0.8, 1.5, 3.0, 6.0)
"""Weights of reflection beside texture that are compared."""

MOST_RADIUS = 10e-3
"""Metres: hair turns within a centimetre."""

UNKNOWN_RADIUS, UNKNOWN_WEIGHT = 4.0, 0.5
"""Spacings and weight where no point is visible to both halves of the cameras."""

NEIGHBOURS = 96
_SAMPLE = 3000  # points at which choices are compared


def pool(
    points: AnyFloats, radius: float, most: int = 24, rows: Ints | None = None
) -> sparse.csr_array:
    """Weights `(M, N)` that average over at most `most` neighbours within `radius` metres.

    For the M of `points (N, 3)` in `rows (M,)`, None for all. A Gaussian of half the radius; each
    row sums to 1. Single precision, as the scores are.
    """
    if not len(points):
        return sparse.csr_array((0, 0), dtype=np.float32)
    at = points if rows is None else np.asarray(points)[rows]
    k = min(most, len(points))
    distance, index = cKDTree(points).query(at, k=np.arange(1, k + 1))
    weight = np.where(distance <= radius, np.exp(-2 * (distance / radius) ** 2), 0)
    weight /= weight.sum(axis=1, keepdims=True)
    row = np.repeat(np.arange(len(at)), k)
    table = sparse.csr_array(
        (weight.astype(np.float32).ravel(), (row, index.ravel())), shape=(len(at), len(points))
    )
    table.eliminate_zeros()
    return table


@dataclass(frozen=True)
class Pooling:
    """The `radius` of averages, metres, and the `weight` of reflection beside texture.

    `agreement` of two halves of the cameras, see `chosen`.
    """

    radius: float
    weight: float
    agreement: float


def chosen(
    points: Array,
    spacing: float,
    texture: Floats,
    reflection: Floats | None,
    radius: float | None = None,
    weight: float | None = None,
) -> Pooling:
    """The radius and weight by which half of the cameras predicts the other half best.

    `texture` and `reflection (2, N, D)` are scores of the same directions by two disjoint sets of
    cameras; `spacing` of `points (N, 3)` in metres. The direction that one half, pooled and
    weighted, scores highest is looked up in the other half at the point itself: too small a radius
    leaves noise, too large a one blurs hair that turns. The agreement is the mean score there in
    standard deviations, summed over both kinds; 0 by chance. A given `radius` or `weight` stays.

    Without a point that both halves score, the agreement is 0 and `UNKNOWN_RADIUS` and
    `UNKNOWN_WEIGHT` are taken. Raises `ValueError` for scores that are not finite.
    """
    if not texture.any(axis=2).all(axis=0).any():
        return Pooling(
            radius or min(UNKNOWN_RADIUS * spacing, MOST_RADIUS),
            UNKNOWN_WEIGHT if weight is None else weight,
            0.0,
        )
    rows = np.unique(np.linspace(0, len(points) - 1, min(len(points), _SAMPLE)).astype(np.int64))
    radii = [r * spacing for r in RADII if r * spacing <= MOST_RADIUS] or [MOST_RADIUS]
    weights = WEIGHTS if weight is None else (weight,)
    kinds = [texture] if reflection is None else [texture, reflection]
    own = [kind[:, rows] for kind in kinds]
    best = Pooling(0.0, 0.0, -np.inf)
    for r in radii if radius is None else [radius]:
        near = pool(points, r, NEIGHBOURS, rows)
        pooled = [[near @ half for half in kind] for kind in kinds]
        for w in weights if reflection is not None else (0.0,):
            both = pooled[0]
            if reflection is not None:
                both = [a + np.float32(w) * b for a, b in zip(*pooled, strict=True)]
            total = sum([agreement(both, list(kind)) for kind in own])
            if total > best.agreement:
                best = Pooling(float(r), float(w), total)
    return best


def agreement(pooled: Sequence[Floats], own: Sequence[Floats]) -> float:
    """How high the best direction of two `pooled (M, D)` scores in each other's `own (M, D)`.

    The mean over that of all directions, in standard deviations; the sum of both ways.
    """
    total = 0.0
    for scores, others in zip(pooled, reversed(own), strict=True):
        spread = float(others.std())
        if not np.isfinite(spread):
            raise ValueError("scores must be finite: check the frames for pixels without a number")
        there = others[np.arange(len(others)), scores.argmax(axis=1)] - others.mean(axis=1)
        total += float(there.mean()) / spread if spread > 0 else 0.0
    return total

"""Averages of scores over neighbouring points, in the radius that the capture supports."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from reconstruction.arrays import AnyFloats, Array, Floats, Ints

RADII = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
"""Radii that are compared, in spacings of the points."""

WEIGHTS = (0.0, 0.15, 0.3, 0.5, 0.8, 1.5, 3.0, 6.0)
"""Weights of reflection beside texture that are compared."""

LINE_WEIGHTS = (0.0, 4.0, 8.0, 16.0, 32.0, 64.0, 128.0)
"""Weights of the lines of points beside texture that are compared."""

LINES_GAIN = 1.05
"""Least gain in agreement by lines of points. Beside a gap in the points they are often wrong,
which costs straight hair more than it gains."""

CLEAR = 10.0
"""Contrast of highlights from which on the agreement of reflection counts whole beside lines."""

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


@dataclass(frozen=True, eq=False)
class Evidence:
    """Scores `(2, N, D)` of the same directions by two disjoint sets of cameras: by `texture`,
    `reflection` and the `lines` in which triangulated points lie."""

    texture: Floats
    reflection: Floats | None = None
    lines: Floats | None = None


@dataclass(frozen=True)
class Pooling:
    """The `radius` of averages, metres, and weights beside texture.

    `weight` of reflection, `lines` of the lines of points. `agreement` of two halves of the
    cameras and its standard `error`, see `chosen`.
    """

    radius: float
    weight: float
    lines: float
    agreement: float
    error: float = 0.0

    def total(self, evidence: Evidence) -> Floats:
        """The weighted scores of both halves `(N, D)`."""
        out = evidence.texture.sum(axis=0)
        for kind, weight in ((evidence.reflection, self.weight), (evidence.lines, self.lines)):
            for half in () if kind is None or weight == 0 else kind:
                out += np.float32(weight) * half
        return out


def chosen(
    points: Array,
    spacing: float,
    evidence: Evidence,
    radius: float | None = None,
    weight: float | None = None,
    lines: float | None = None,
    contrast: float = CLEAR,
) -> Pooling:
    """The radius and weights by which half of the cameras predicts the other half best.

    `spacing` of `points (N, 3)` in metres. The direction that one half, pooled and weighted, scores
    highest is looked up in the other half at the point itself: too small a radius leaves noise, too
    large a one blurs hair that turns. The agreement is the mean score there in standard deviations;
    0 by chance, summed over the kinds. Beside lines, reflection counts by the `contrast` of its
    highlights, from 0 at 1 to 1 at `CLEAR`: its halves share lights and shadows, and agree on these
    where highlights are faint. Lines that add less than `LINES_GAIN` have weight 0. A given
    `radius` or weight stays.

    Texture and reflection have blur of their own and do not show all that an average blurs. So the
    smallest radius is taken whose agreement is within a standard error of the best (Breiman et al.
    1984, §3.4.3), and of these the largest weight of lines.

    Without a point that both halves score, the agreement is 0 and `UNKNOWN_RADIUS` and
    `UNKNOWN_WEIGHT` are taken. Raises `ValueError` for scores that are not finite.
    """
    texture = evidence.texture
    if not texture.any(axis=2).all(axis=0).any():
        return Pooling(
            radius or min(UNKNOWN_RADIUS * spacing, MOST_RADIUS),
            UNKNOWN_WEIGHT if weight is None else weight,
            0.0 if lines is None else lines,
            0.0,
        )
    rows = np.unique(np.linspace(0, len(points) - 1, min(len(points), _SAMPLE)).astype(np.int64))
    radii = [r * spacing for r in RADII if r * spacing <= MOST_RADIUS] or [MOST_RADIUS]
    kinds = texture, evidence.reflection, evidence.lines
    own = [None if kind is None else [_standard(half[rows]) for half in kind] for kind in kinds]
    clear = 1.0 if evidence.lines is None else np.clip((contrast - 1) / (CLEAR - 1), 0, 1)
    shares = 1.0, float(clear), 1.0
    tried: list[Pooling] = []
    for r in radii if radius is None else [radius]:
        near = pool(points, r, NEIGHBOURS, rows)
        alone = [near @ half for half in texture]
        for first, w in _weighted(near, evidence.reflection, weight, WEIGHTS, alone):
            for both, c in _weighted(near, evidence.lines, lines, LINE_WEIGHTS, first):
                tops = [scores.argmax(axis=1) for scores in both]
                each = (0.0 if kind is None else _agreement(tops, kind) for kind in own)
                total = np.asarray(sum(share * x for share, x in zip(shares, each, strict=True)))
                error = float(total.std() / np.sqrt(total.size))
                tried.append(Pooling(float(r), float(w), float(c), float(total.mean()), error))
    plain, best = [p for p in tried if p.lines == 0], max(tried, key=_agreed)
    if plain and best.agreement <= LINES_GAIN * max(plain, key=_agreed).agreement:
        tried, best = plain, max(plain, key=_agreed)
    enough = [p for p in tried if p.agreement >= best.agreement - best.error]
    least = min(p.radius for p in enough)
    return max((p for p in enough if p.radius == least), key=lambda p: (p.lines, p.agreement))


def _agreed(pooling: Pooling) -> float:
    return pooling.agreement


def _weighted(
    near: sparse.csr_array,
    kind: Floats | None,
    given: float | None,
    weights: Sequence[float],
    base: list[Floats],
) -> Iterator[tuple[list[Floats], float]]:
    """`base`, two of `(M, D)`, with the halves of a `kind` pooled and added by each weight."""
    if kind is None:
        yield base, 0.0
        return
    pooled = [near @ half for half in kind]
    for w in weights if given is None else (given,):
        yield [a + np.float32(w) * b for a, b in zip(base, pooled, strict=True)], w


def _standard(scores: Floats) -> Floats:
    """`scores (M, D)` over their mean over the directions, in standard deviations."""
    spread = float(scores.std())
    if not np.isfinite(spread):
        raise ValueError("scores must be finite: check the frames for pixels without a number")
    return (scores - scores.mean(axis=1, keepdims=True)) / np.float32(spread if spread > 0 else 1.0)


def _agreement(tops: Sequence[Ints], standard: Sequence[Floats]) -> Floats:
    """How high two halves' best directions `tops (M,)` score in each other's `standard (M, D)`.

    `(M,)`, the sum of both ways.
    """
    first, second = standard
    row = np.arange(len(first))
    return np.asarray(second[row, tops[0]] + first[row, tops[1]])

"""Strands against the true ones: precision, recall and F at 1 mm/10°, 2 mm/20° and 3 mm/30°."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from reconstruction.arrays import Bools
from reconstruction.evaluation.oriented_points import Block, Drawn, OrientedPoints, near_pairs
from reconstruction.evaluation.visibility import Visibility
from reconstruction.geometry.strands import Strands


@dataclass(frozen=True)
class Threshold:
    """A point matches within `distance` metres and under `angle` degrees."""

    distance: float
    angle: float

    @property
    def name(self) -> str:
        """As in `1mm_10deg`."""
        return f"{self.distance * 1e3:g}mm_{self.angle:g}deg"


# ascending in both: whoever matches one matches all that follow
THRESHOLDS = (Threshold(1e-3, 10.0), Threshold(2e-3, 20.0), Threshold(3e-3, 30.0))


class Matches:
    """For each threshold, which of the `drawn (N,)` points match a point shown so far.

    `found (T, n)` takes tangents as lines, `directed (T, n)` as arrows from root to tip.
    """

    def __init__(self, drawn: Drawn) -> None:
        self.drawn = drawn
        self.found = np.zeros((len(THRESHOLDS), len(drawn.points)), bool)
        self.directed = np.zeros_like(self.found)

    def look(self, block: Block) -> None:
        """Match what has no match yet with the points of `block`."""
        for k, threshold in enumerate(THRESHOLDS):
            todo = np.flatnonzero(~self.directed[k])  # a directed match is an undirected one
            for i, j in near_pairs(self.drawn.points[todo], block, threshold.distance):
                a, b = self.drawn.tangents[todo[i]], block.tangents[j]
                cosine = np.einsum("nk,nk->n", a, b)
                least = np.cos(np.radians(threshold.angle))
                # what matches narrowly matches widely
                self.found[k:, todo[i[np.abs(cosine) > least]]] = True
                self.directed[k:, todo[i[cosine > least]]] = True


def scores(
    precision: Matches,
    recall: Matches,
    *,
    directed: bool = False,
    predicted: Bools | None = None,
    true: Bools | None = None,
) -> dict[str, dict[str, float]]:
    """Precision, recall and F at each threshold, as `compare_strands` returns them.

    With `predicted (N,)` and `true (m,)` only of those of the drawn points.
    """
    out = {}
    for k, threshold in enumerate(THRESHOLDS):
        p, dp = _share(precision, k, directed, predicted)
        r, dr = _share(recall, k, directed, true)
        f = 2 * p * r / (p + r) if p + r > 0 else 0.0
        errors = {"precision_error": dp, "recall_error": dr}
        out[threshold.name] = {"precision": p, "recall": r, "f": f, **errors}
    return out


def _share(matches: Matches, k: int, directed: bool, among: Bools | None) -> tuple[float, float]:
    """The share of points that match, and its standard error by sampling: 0 if all are scored."""
    found = (matches.directed if directed else matches.found)[k]
    found = found if among is None else found[among]
    n = len(found)
    share = float(found.mean()) if n else 0.0
    sampled = n > 1 and not matches.drawn.complete
    return share, float(np.sqrt(share * (1 - share) / (n - 1))) if sampled else 0.0


@dataclass(frozen=True)
class StrandComparison:
    """Matches of both sets: points drawn from all, and from what cameras see."""

    all: tuple[Matches, Matches]
    visible: tuple[Matches, Matches] | None

    @property
    def of_predicted(self) -> list[Matches]:
        """Those that have to be shown the truth."""
        return [pair[0] for pair in (self.visible, self.all) if pair]

    @property
    def of_truth(self) -> list[Matches]:
        """Those that have to be shown the prediction."""
        return [pair[1] for pair in (self.visible, self.all) if pair]

    def figures(self) -> dict[str, Any]:
        """What `compare_strands` returns."""
        parts = {"visible": self.visible, "all": self.all}
        there = {name: pair for name, pair in parts.items() if pair}
        return {
            **{name: scores(*pair) for name, pair in there.items()},
            "directed": {name: scores(*pair, directed=True) for name, pair in there.items()},
        }


def draw(
    predicted: OrientedPoints,
    truth: OrientedPoints,
    *,
    seed: int = 0,
    samples: int | None = 40_000,
    visibility: Visibility | None = None,
) -> StrandComparison:
    """Draw the points to compare; nothing is matched yet. Raises as `compare_strands` does."""
    if truth.count == 0:
        raise ValueError("there are no true strands to compare with")
    rng = np.random.default_rng(seed)
    visible = None
    if visibility is not None:
        seen = truth.draw(samples, rng, visibility)
        if not len(seen.points):
            raise ValueError("no camera sees any of the true strands: are they in one frame?")
        visible = Matches(predicted.draw(samples, rng, visibility)), Matches(seen)
    everything = Matches(predicted.draw(samples, rng)), Matches(truth.draw(samples, rng))
    return StrandComparison(everything, visible)


def compare_strands(
    pred: Strands,
    true: Strands,
    *,
    visibility: Visibility | None = None,
    seed: int = 0,
    samples: int | None = 40_000,
) -> dict[str, Any]:
    """Score predicted strands against the true ones.

    Both sets are resampled at 1 mm. A point matches if *any* point of the other set lies within
    the distance and has a tangent within the angle, direction of travel aside. Precision is the
    share of predicted points that match a true one, recall the share of true points that match a
    predicted one, F their harmonic mean.

    Returns `{"visible": scores, "all": scores, "directed": {"visible": scores, "all": scores}}`,
    without the visible ones where no `visibility` of the true strands is given. Visible precision
    scores the visible predictions against all of the truth, visible recall the visible truth
    against all predictions; visible is what is not hidden from every camera by the true strands or
    the head by more than 1 mm. Directed ones compare tangents as arrows from root to tip. `scores`
    maps `1mm_10deg`, `2mm_20deg`, `3mm_30deg` to
    `{"precision", "recall", "f", "precision_error", "recall_error"}`.

    At most `samples` points of each set are scored (all of them for None), drawn by `seed`, always
    against the whole other set; the `_error`s are the standard errors that this leaves. Without
    predicted points to score, precision is 0.

    Raises `ValueError` when there is no true strand, no camera sees a true point, or strands are
    so long that they cannot be in metres.
    """
    predicted, truth = OrientedPoints(pred), OrientedPoints(true)
    comparison = draw(predicted, truth, seed=seed, samples=samples, visibility=visibility)
    truth.show(*comparison.of_predicted)
    predicted.show(*comparison.of_truth)
    return comparison.figures()

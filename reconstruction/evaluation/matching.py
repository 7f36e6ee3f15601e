"""Precision, recall and F of strands at 1 mm/10°, 2 mm/20° and 3 mm/30°."""

from __future__ import annotations

from typing import Any

import numpy as np

from reconstruction.arrays import Bools
from reconstruction.evaluation.connectivity import (
    SampledStrands,
    connectivity_figures,
    length_figures,
)
from reconstruction.evaluation.oriented_points import (
    THRESHOLDS,
    Block,
    BlockConsumer,
    Drawn,
    OrientedPoints,
    PointTest,
    near_pairs,
)
from reconstruction.geometry.strands import Strands


class Matches:
    """For each threshold, which of the `drawn (N,)` points match a point of the other set.

    `found (T, n)` with undirected, `directed (T, n)` with directed tangents (root to tip).
    """

    def __init__(self, drawn: Drawn) -> None:
        self.drawn = drawn
        self.found = np.zeros((len(THRESHOLDS), len(drawn.points)), bool)
        self.directed = np.zeros_like(self.found)

    def look(self, block: Block) -> None:
        """Match unmatched points with the points of `block`."""
        todo = np.flatnonzero(~self.directed[0])  # a directed match is an undirected one
        for i, j, apart in near_pairs(self.drawn.points[todo], block, THRESHOLDS[-1].distance):
            cosine = np.einsum("nk,nk->n", self.drawn.tangents[todo[i]], block.tangents[j])
            for k, threshold in enumerate(THRESHOLDS):
                near, least = apart <= threshold.distance, np.cos(np.radians(threshold.angle))
                self.found[k, todo[i[near & (np.abs(cosine) > least)]]] = True
                self.directed[k, todo[i[near & (cosine > least)]]] = True


def scores(
    precision: Matches,
    recall: Matches,
    *,
    directed: bool = False,
    predicted: Bools | None = None,
) -> dict[str, dict[str, float]]:
    """Precision, recall and F at each threshold, as `compare_strands` returns them.

    With `predicted (N,)`, precision counts only these of the drawn predicted points.
    """
    out = {}
    for k, threshold in enumerate(THRESHOLDS):
        p, dp = _share(precision, k, directed, predicted)
        r, dr = _share(recall, k, directed, None)
        f = 2 * p * r / (p + r) if p + r > 0 else 0.0
        errors = {"precision_error": dp, "recall_error": dr}
        out[threshold.name] = {"precision": p, "recall": r, "f": f, **errors}
    return out


def _share(matches: Matches, k: int, directed: bool, among: Bools | None) -> tuple[float, float]:
    """The share of matching points, and its standard error by sampling, 0 if all are scored."""
    found = (matches.directed if directed else matches.found)[k]
    found = found if among is None else found[among]
    n = len(found)
    share = float(found.mean()) if n else 0.0
    sampled = n > 1 and not matches.drawn.complete
    return share, float(np.sqrt(share * (1 - share) / (n - 1))) if sampled else 0.0


class StrandComparison:
    """Matches of two sets, of points sampled from `all` and from the `visible` ones.

    Also the correspondence of whole strands, and matches of the prediction at equal length. Call
    `match_predicted` and `match_true` before `figures`. Raises as `compare_strands` does.
    """

    def __init__(
        self,
        pred: Strands,
        true: Strands,
        *,
        seed: int = 0,
        samples: int | None = 40_000,
        visibility: PointTest | None = None,
    ) -> None:
        self.pred, self.true = pred, true
        self.predicted, self.truth = OrientedPoints(pred), OrientedPoints(true)
        if self.truth.count == 0:
            raise ValueError("there are no true strands to compare with")
        rng = np.random.default_rng(seed)

        def drawn(visible: PointTest | None) -> tuple[Matches, Matches]:
            theirs = self.truth.draw(samples, rng, visible)
            if not len(theirs.points):
                raise ValueError(
                    "no true strand is visible in any camera: check that both are in one frame"
                )
            return Matches(self.predicted.draw(samples, rng, visible)), Matches(theirs)

        self.visible = None if visibility is None else drawn(visibility)
        self.all = drawn(None)
        parts = {"visible": self.visible, "all": self.all}
        self._parts = {name: pair for name, pair in parts.items() if pair}
        self._kept = equal_length(pred, true, seed)
        self._kept_recall = {k: Matches(pair[1].drawn) for k, pair in self._parts.items()}
        self._predicted_strands = SampledStrands(self.predicted, seed) if len(pred) else None
        self._true_strands = SampledStrands(self.truth, seed, THRESHOLDS)

    def match_predicted(self, *more: BlockConsumer) -> None:
        """Match the predicted points; `more` also receives the blocks of the truth."""
        mine = [self._predicted_strands] if self._predicted_strands else []
        self.truth.feed(*(pair[0] for pair in self._parts.values()), *mine, *more)

    def match_true(self, *more: BlockConsumer) -> None:
        """Match the true points; `more` also receives the blocks of the prediction."""
        recalls = [pair[1] for pair in self._parts.values()]
        self.predicted.feed(*recalls, self._true_strands, *more)
        if self._kept.all():
            self._kept_recall = dict(zip(self._parts, recalls, strict=True))
        else:
            OrientedPoints(self.pred.subset(self._kept)).feed(*self._kept_recall.values())

    def figures(self) -> dict[str, Any]:
        """What `compare_strands` returns."""
        return {
            **{name: scores(*pair) for name, pair in self._parts.items()},
            "directed": {k: scores(*pair, directed=True) for k, pair in self._parts.items()},
            "equal_length": {
                k: scores(mine, self._kept_recall[k], predicted=self._kept[mine.drawn.strand])
                for k, (mine, _) in self._parts.items()
            },
            "lengths": length_figures(self.pred, self.true),
            "connectivity": connectivity_figures(self._predicted_strands, self._true_strands),
        }


def equal_length(pred: Strands, true: Strands, seed: int = 0) -> Bools:
    """A random subset `(S,)` of the predicted strands with the true total length.

    All of them if their total length is not larger.
    """
    lengths, wanted = pred.lengths(), float(true.lengths().sum())
    kept = np.ones(len(pred), bool)
    if lengths.sum() > wanted:
        order = np.random.default_rng(seed).permutation(len(pred))
        # up to the last one whose middle fits: the nearest total length
        middle = np.cumsum(lengths[order]) - lengths[order] / 2
        kept[order[max(1, int(np.searchsorted(middle, wanted))) :]] = False
    return kept


def compare_strands(
    pred: Strands,
    true: Strands,
    *,
    visibility: PointTest | None = None,
    seed: int = 0,
    samples: int | None = 40_000,
) -> dict[str, Any]:
    """Score predicted strands against the true ones.

    Both sets are resampled at 1 mm. A point matches if any point of the other set lies within the
    distance and has an undirected tangent within the angle. Precision is the share of predicted
    points that match a true one, recall the share of true points that match a predicted one, F
    their harmonic mean.

    Returns

    - `visible` and `all`: scores; `visible` only with the `visibility` of the true strands: visible
      predictions against the whole truth, and visible truth against all predictions. Points hidden
      in every camera by the true strands or the head by more than 1 mm are not visible;
    - `directed.{visible,all}`: with directed tangents;
    - `equal_length.{visible,all}`: of the prediction at the true total length (`equal_length`),
      since density raises recall;
    - `lengths` (`length_figures`), `connectivity` (`connectivity_figures`, with the strand
      consistency of HairGS).

    Scores map `1mm_10deg`, `2mm_20deg`, `3mm_30deg` to
    `{"precision", "recall", "f", "precision_error", "recall_error"}`.

    At most `samples` random points of each set (None: all) are scored against the whole other set;
    the `_error`s are standard errors of this sampling. Without predicted points precision is 0.

    Raises `ValueError` without true strands, without a visible true point, or for strands too long
    to be in metres.
    """
    comparison = StrandComparison(pred, true, seed=seed, samples=samples, visibility=visibility)
    comparison.match_predicted()
    comparison.match_true()
    return comparison.figures()

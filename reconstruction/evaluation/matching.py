"""Strands against the true ones: precision, recall and F at 1 mm/10°, 2 mm/20° and 3 mm/30°."""

from __future__ import annotations

from typing import Any

import numpy as np

from reconstruction.arrays import Bools
from reconstruction.evaluation.connectivity import Followed, connectivity_figures, length_figures
from reconstruction.evaluation.oriented_points import (
    THRESHOLDS,
    Block,
    Drawn,
    Looker,
    OrientedPoints,
    Sees,
    near_pairs,
)
from reconstruction.geometry.strands import Strands


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
    """The share of points that match, and its standard error by sampling: 0 if all are scored."""
    found = (matches.directed if directed else matches.found)[k]
    found = found if among is None else found[among]
    n = len(found)
    share = float(found.mean()) if n else 0.0
    sampled = n > 1 and not matches.drawn.complete
    return share, float(np.sqrt(share * (1 - share) / (n - 1))) if sampled else 0.0


class StrandComparison:
    """Matches of two sets, of points drawn from `all` and from what cameras see (`visible`).

    Beside them which strands lie along which of those that were followed, and the prediction at
    equal length: what true points match of the strands that `equal_length` keeps. Nothing is
    matched before `look_at_truth` and `look_at_prediction`. Raises as `compare_strands` does.
    """

    def __init__(
        self,
        pred: Strands,
        true: Strands,
        *,
        seed: int = 0,
        samples: int | None = 40_000,
        visibility: Sees | None = None,
    ) -> None:
        self.pred, self.true = pred, true
        self.predicted, self.truth = OrientedPoints(pred), OrientedPoints(true)
        if self.truth.count == 0:
            raise ValueError("there are no true strands to compare with")
        rng = np.random.default_rng(seed)

        def drawn(sees: Sees | None) -> tuple[Matches, Matches]:
            theirs = self.truth.draw(samples, rng, sees)
            if not len(theirs.points):
                raise ValueError("no camera sees any of the true strands: are they in one frame?")
            return Matches(self.predicted.draw(samples, rng, sees)), Matches(theirs)

        self.visible = None if visibility is None else drawn(visibility)
        self.all = drawn(None)
        parts = {"visible": self.visible, "all": self.all}
        self._parts = {name: pair for name, pair in parts.items() if pair}
        self._kept = equal_length(pred, true, seed)
        self._kept_recall = {k: Matches(pair[1].drawn) for k, pair in self._parts.items()}
        self._followed = Followed(self.predicted, seed) if len(pred) else None
        self._true_followed = Followed(self.truth, seed)

    def look_at_truth(self, *more: Looker) -> None:
        """Match the predicted points; `more` is shown the truth as well."""
        mine = [self._followed] if self._followed else []
        self.truth.show(*(pair[0] for pair in self._parts.values()), *mine, *more)

    def look_at_prediction(self, *more: Looker) -> None:
        """Match the true points; `more` is shown the prediction as well."""
        recalls = [pair[1] for pair in self._parts.values()]
        self.predicted.show(*recalls, self._true_followed, *more)
        if self._kept.all():
            self._kept_recall = dict(zip(self._parts, recalls, strict=True))
        else:
            OrientedPoints(self.pred.subset(self._kept)).show(*self._kept_recall.values())

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
            "connectivity": connectivity_figures(self._followed, self._true_followed),
        }


def equal_length(pred: Strands, true: Strands, seed: int = 0) -> Bools:
    """Which predicted strands `(S,)` to keep, whole and drawn by `seed`, for the true metres.

    All of them where they are no longer than the truth in all.
    """
    lengths, wanted = pred.lengths(), float(true.lengths().sum())
    kept = np.ones(len(pred), bool)
    if lengths.sum() > wanted:
        order = np.random.default_rng(seed).permutation(len(pred))
        # up to the last one whose middle still fits: no other number of them comes nearer
        middle = np.cumsum(lengths[order]) - lengths[order] / 2
        kept[order[max(1, int(np.searchsorted(middle, wanted))) :]] = False
    return kept


def compare_strands(
    pred: Strands,
    true: Strands,
    *,
    visibility: Sees | None = None,
    seed: int = 0,
    samples: int | None = 40_000,
) -> dict[str, Any]:
    """Score predicted strands against the true ones.

    Both sets are resampled at 1 mm. A point matches if *any* point of the other set lies within
    the distance and has a tangent within the angle, direction of travel aside. Precision is the
    share of predicted points that match a true one, recall the share of true points that match a
    predicted one, F their harmonic mean.

    Returns

    - `visible` and `all`: scores; the visible ones only where the `visibility` of the true strands
      is given. Visible precision scores the visible predictions against all of the truth, visible
      recall the visible truth against all predictions; visible is what is not hidden from every
      camera by the true strands or the head by more than 1 mm;
    - `directed.{visible,all}`: with tangents as arrows from root to tip;
    - `equal_length.{visible,all}`: of the prediction cut to the true metres (`equal_length`): many
      strands side by side buy recall;
    - `lengths` (`length_figures`), `connectivity` (`connectivity_figures`).

    Scores map `1mm_10deg`, `2mm_20deg`, `3mm_30deg` to
    `{"precision", "recall", "f", "precision_error", "recall_error"}`.

    At most `samples` points of each set are scored (all of them for None), drawn by `seed`, always
    against the whole other set; the `_error`s are the standard errors that this leaves. Without
    predicted points to score, precision is 0.

    Raises `ValueError` when there is no true strand, no camera sees a true point, or strands are
    so long that they cannot be in metres.
    """
    comparison = StrandComparison(pred, true, seed=seed, samples=samples, visibility=visibility)
    comparison.look_at_truth()
    comparison.look_at_prediction()
    return comparison.figures()

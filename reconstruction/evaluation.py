"""Strands against the true ones: precision, recall and F at 1 mm/10°, 2 mm/20° and 3 mm/30°."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from reconstruction.cameras import Camera
from reconstruction.mesh import Mesh
from reconstruction.strands import Strands
from reconstruction.visibility import Visibility

Array = NDArray[np.floating]
Bool = NDArray[np.bool_]

STEP = 1e-3
"""Metres between the points that both sets are resampled to."""

MOST_PAIRS = 4_000_000
"""Neighbour pairs that are looked at together: bounds the memory, not the answer."""

OVERSAMPLING = 5
"""Points that are tested for visibility, for each visible one that is wanted."""


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


def compare_strands(
    pred: Strands,
    true: Strands,
    *,
    cameras: Sequence[Camera] | None = None,
    head: Mesh | None = None,
    seed: int = 0,
    samples: int | None = 40_000,
    visibility: Visibility | None = None,
) -> dict[str, Any]:
    """Score predicted strands against the true ones.

    Both sets are resampled at 1 mm. A point matches if *any* point of the other set lies within
    the distance and has a tangent within the angle, direction of travel aside. Precision is the
    share of predicted points that match a true one, recall the share of true points that match a
    predicted one, F their harmonic mean.

    Returns `{"visible": scores, "all": scores}`, or `{"all": scores}` without `cameras`. Visible
    precision scores the visible predictions against all of the truth, visible recall the visible
    truth against all predictions; visible is what is not hidden from every camera by the true
    strands or the `head` by more than 1 mm. `scores` maps `1mm_10deg`, `2mm_20deg`, `3mm_30deg` to
    `{"precision", "recall", "f", "precision_error", "recall_error"}`.

    At most `samples` points of each set are scored (all of them for None), drawn by `seed`, always
    against the whole other set; the `_error`s are the standard errors that this leaves. Without
    predicted points to score, precision is 0. To score several predictions of one truth, make its
    `Visibility` once and hand it over.

    Raises `ValueError` when there is no true strand, or no camera sees a true point.
    """
    if len(true) == 0:
        raise ValueError("there are no true strands to compare with")
    rng = np.random.default_rng(seed)
    predicted, truth = _Oriented(pred), _Oriented(true)
    out: dict[str, Any] = {}
    if cameras is not None:
        sees = visibility if visibility is not None else Visibility(cameras, true, head)
        seen_truth = truth.draw(samples, rng, sees)
        if not seen_truth.chosen.size:
            raise ValueError("no camera sees any of the true strands: are they in one frame?")
        out["visible"] = _scores(
            predicted.match(truth, predicted.draw(samples, rng, sees)),
            truth.match(predicted, seen_truth),
        )
    out["all"] = _scores(
        predicted.match(truth, predicted.draw(samples, rng)),
        truth.match(predicted, truth.draw(samples, rng)),
    )
    return out


@dataclass(frozen=True)
class _Draw:
    """Points to score: indices `chosen (n,)`, and whether they are all that there are to score."""

    chosen: NDArray[np.int64]
    complete: bool


@dataclass(frozen=True)
class _Matches:
    """For each threshold, which of the scored points match `(T, n)`."""

    found: Bool
    complete: bool

    def share(self) -> list[float]:
        n = self.found.shape[1]
        return [float(row.mean()) if n else 0.0 for row in self.found]

    def error(self) -> list[float]:
        """Standard error of `share` by sampling; 0 where all points were scored."""
        n = self.found.shape[1]
        if self.complete or n < 2:
            return [0.0] * len(self.found)
        return [float(np.sqrt(p * (1 - p) / (n - 1))) for p in self.share()]


class _Oriented:
    """Points with unit tangents at `STEP`, and a tree to find them by."""

    def __init__(self, strands: Strands) -> None:
        strands = strands.resampled(STEP)
        self.points, self.tangents = strands.points, strands.tangents()
        self.tree = cKDTree(self.points, balanced_tree=False, compact_nodes=False)

    def draw(
        self, samples: int | None, rng: np.random.Generator, sees: Visibility | None = None
    ) -> _Draw:
        """At most `samples` of the points, or of those that `sees` says are visible."""
        count = len(self.points)
        if samples is None:
            samples = count
        tried = count if sees is None else min(count, OVERSAMPLING * samples)
        chosen = np.arange(count)
        if tried < count:
            chosen = rng.choice(count, tried, replace=False)
        if sees is not None:
            chosen = chosen[sees(self.points[chosen])]
        complete = tried == count and len(chosen) <= samples
        if len(chosen) > samples:
            chosen = rng.choice(chosen, samples, replace=False)
        return _Draw(np.sort(chosen), complete)

    def match(self, other: _Oriented, draw: _Draw) -> _Matches:
        """Match the drawn points with `other`."""
        which = draw.chosen
        found = np.zeros((len(THRESHOLDS), len(which)), bool)
        todo = np.arange(len(which) if len(other.points) else 0)
        for k, threshold in enumerate(THRESHOLDS):
            hit = self._near(other, which[todo], threshold)
            found[k:, todo[hit]] = True  # what matches narrowly matches widely
            todo = todo[~hit]
        return _Matches(found, draw.complete)

    def _near(self, other: _Oriented, which: NDArray[np.int64], threshold: Threshold) -> Bool:
        """Which of the points `which` have a match in `other`."""
        out = np.zeros(len(which), bool)
        if len(which) == 0:
            return out
        points, reach = self.points[which], threshold.distance
        near = other.tree.query_ball_point(points, reach, return_length=True, workers=-1)
        part = np.cumsum(near) // MOST_PAIRS
        for k in np.unique(part):
            chunk = np.flatnonzero((part == k) & (near > 0))
            if len(chunk) == 0:
                continue
            pairs = cKDTree(points[chunk]).sparse_distance_matrix(
                other.tree, reach, output_type="ndarray"
            )
            a, b = self.tangents[which[chunk[pairs["i"]]]], other.tangents[pairs["j"]]
            cosine = np.abs(np.einsum("nk,nk->n", a, b))
            out[chunk[pairs["i"][cosine > np.cos(np.radians(threshold.angle))]]] = True
        return out


def _scores(precision: _Matches, recall: _Matches) -> dict[str, dict[str, float]]:
    rows = zip(
        THRESHOLDS,
        precision.share(),
        recall.share(),
        precision.error(),
        recall.error(),
        strict=True,
    )
    return {
        t.name: {
            "precision": p,
            "recall": r,
            "f": 2 * p * r / (p + r) if p + r > 0 else 0.0,
            "precision_error": dp,
            "recall_error": dr,
        }
        for t, p, r, dp, dr in rows
    }

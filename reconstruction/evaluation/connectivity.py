"""Correspondence of whole strands between two sets."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from reconstruction.arrays import Array, Ints
from reconstruction.evaluation.oriented_points import (
    THRESHOLDS,
    Block,
    OrientedPoints,
    Threshold,
    near_pairs,
)
from reconstruction.geometry.strands import Strands

LIES_ON = THRESHOLDS[1]
"""A point lies on a strand with a point within this distance and undirected angle."""

MOST_STRANDS, MOST_POINTS = 1_000, 60_000
"""Most strands sampled, and most of their points."""

PERCENTILES = (5, 25, 50, 75, 95)


def spread(values: Array) -> dict[str, float]:
    """Mean and percentiles of `values (N,)`, n > 0: `mean`, `p5`, `p25`, `p50`, `p75`, `p95`."""
    marks = zip(PERCENTILES, np.percentile(values, PERCENTILES), strict=True)
    return {"mean": float(values.mean()), **{f"p{p}": float(v) for p, v in marks}}


def length_figures(pred: Strands, true: Strands) -> dict[str, Any]:
    """Strand lengths of both sets, in millimetres.

    `{"pred": {"strands", "total_m", "mean", "p5", …, "p95"}, "true": the same, "distance_mm"}`;
    the distance is the first Wasserstein distance of the distributions. Spread and distance are
    omitted without strands.
    """
    from scipy.stats import wasserstein_distance

    lengths = {name: 1e3 * s.lengths() for name, s in (("pred", pred), ("true", true))}
    out: dict[str, Any] = {
        name: {
            "strands": len(values),
            "total_m": float(values.sum()) * 1e-3,
            **(spread(values) if len(values) else {}),
        }
        for name, values in lengths.items()
    }
    if all(len(v) for v in lengths.values()):
        out["distance_mm"] = float(wasserstein_distance(lengths["pred"], lengths["true"]))
    return out


class SampledStrands:
    """Strands sampled from one set, and the strands of the other that lie along each.

    `thresholds` contains `LIES_ON`.
    """

    def __init__(
        self, points: OrientedPoints, seed: int = 0, thresholds: Sequence[Threshold] = (LIES_ON,)
    ) -> None:
        order = np.random.default_rng(seed).permutation(len(points.offsets) - 1)[:MOST_STRANDS]
        total = np.cumsum(np.diff(points.offsets)[order])
        self.strands = np.sort(order[: max(1, int((total <= MOST_POINTS).sum()))])
        self.complete = len(self.strands) == len(points.offsets) - 1
        self._block = points.of_strands(self.strands)
        self._counts = np.diff(points.offsets)[self.strands]
        self._owner = np.repeat(np.arange(len(self.strands)), self._counts)
        self._best = {threshold: np.zeros(len(self.strands), int) for threshold in thresholds}
        self._on_any = np.zeros(len(self._block.points), bool)

    def look(self, block: Block) -> None:
        """Process a block of the other set; each of its strands is in one block only."""
        first, count = block.strand[0], block.strand[-1] - block.strand[0] + 1
        parts: dict[Threshold, list[Ints]] = {t: [np.zeros(0, np.int64)] for t in self._best}
        reach = max(t.distance for t in self._best)
        for i, j, apart in near_pairs(self._block.points, block, reach):
            cosine = np.einsum("nk,nk->n", self._block.tangents[i], block.tangents[j])
            # count a point near several points of one strand once
            pairs = i * count + (block.strand[j] - first)
            for threshold, found in parts.items():
                least = np.cos(np.radians(threshold.angle))
                hit = (apart <= threshold.distance) & (np.abs(cosine) > least)
                found.append(np.unique(pairs[hit]))
        for threshold, best in self._best.items():
            point, other = np.divmod(np.concatenate(parts[threshold]), count)
            pair, on_it = np.unique(self._owner[point] * count + other, return_counts=True)
            np.maximum.at(best, pair // count, on_it)
            if threshold == LIES_ON:
                self._on_any[point] = True

    def shares(self, threshold: Threshold = LIES_ON) -> Array:
        """The largest share of each sampled strand that lies on one other strand `(N,)`."""
        return np.asarray(self._best[threshold] / self._counts)

    def covered(self) -> Array:
        """The share of each sampled strand that lies on any other strand `(N,)`."""
        starts = np.cumsum(self._counts) - self._counts
        return np.asarray(np.add.reduceat(self._on_any, starts, dtype=float) / self._counts)


def connectivity_figures(pred: SampledStrands | None, true: SampledStrands) -> dict[str, Any]:
    """Correspondence of whole strands, by strands sampled from both sets, true at all `THRESHOLDS`.

    `pred.on_one`: the largest share of a predicted strand that lies on one true strand;
    `true.by_one`: the largest share of a true strand covered by one predicted strand;
    `true.covered`: the share covered by all of them. Each with mean, percentiles and the mean's
    standard error.

    `true.strand_consistency`: the mean of `by_one` at each threshold, the metric of Pan et al.,
    "HairGS: Hair Strand Reconstruction based on 3D Gaussian Splatting", BMVC 2025. Additional
    predicted strands never lower it, since one of them may lie along several true strands and none
    is compared in length.
    """
    out: dict[str, Any] = {"lies_on": LIES_ON.name, "true": {"followed": len(true.strands)}}
    for name, values in (("by_one", true.shares()), ("covered", true.covered())):
        out["true"][name] = _spread_and_error(values, true.complete)
    out["true"]["strand_consistency"] = {
        threshold.name: float(true.shares(threshold).mean()) for threshold in THRESHOLDS
    }
    if pred is not None:
        on_one = _spread_and_error(pred.shares(), pred.complete)
        out["pred"] = {"followed": len(pred.strands), "on_one": on_one}
    return out


def _spread_and_error(values: Array, complete: bool) -> dict[str, float]:
    sampled = not complete and len(values) > 1
    error = float(values.std(ddof=1) / np.sqrt(len(values))) if sampled else 0.0
    return {**spread(values), "error": error}

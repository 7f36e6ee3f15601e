"""How well 3D lines are determined: do the planes of the views that see them cross, and in one?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from reconstruction.arrays import AnyFloats, Array, Bools, Ints
from reconstruction.tangents.line_evidence import LineEvidence

NEARLY_PARALLEL = 0.1
"""`spread` under which a line may turn freely within the planes: they cross at some ten degrees."""


@dataclass(frozen=True, eq=False)
class LineConditioning:
    """Of each point's line `(N,)`, from the planes through its images in the views that see it.

    `views` counts the views whose texture has an orientation there. With the singular values
    s1 >= s2 >= s3 of the planes' normals, weighted: `spread` is s2 / s1, from 0 where all planes
    are parallel (or there is only one) to 1; `misfit` is s3 / s2, 0 where all planes meet in one
    line, as two always do (Sun Eq. 4; Photobooth §3.2 takes the two most frontal views alone).
    """

    views: Ints
    spread: Array
    misfit: Array

    def figures(self) -> dict[str, Any]:
        """Counts of views, percentiles, and the share of undetermined lines, JSON-ready."""
        if not len(self.views):
            return {"views_per_point": {}, "undetermined_share": 0.0}
        determined = self.spread >= NEARLY_PARALLEL
        several = self.views > 2

        def percentiles(values: Array) -> dict[str, float] | None:
            if not len(values):
                return None
            return {f"p{q}": float(np.percentile(values, q)) for q in (10, 50, 90)}

        return {
            "views_per_point": {str(k): int(n) for k, n in enumerate(np.bincount(self.views)) if n},
            "spread": percentiles(self.spread[self.views > 1]),
            "misfit": percentiles(self.misfit[several & determined]),
            "undetermined_share": float((~determined).mean()),
        }


def condition_lines(
    evidences: Sequence[LineEvidence],
    points: AnyFloats,
    seen: Bools,
    *,
    least_confidence: float = 0.1,
) -> LineConditioning:
    """Conditioning of the lines at `points (N, 3)`; `seen (N, V)` says which view sees which.

    A view's line is the mean of its support over doubled angles, and its weight that mean's length:
    0 where all angles answer alike, near 1 for a single one. Views below `least_confidence` do not
    count.
    """
    if seen.shape != (len(points), len(evidences)):
        raise ValueError(f"seen must be {(len(points), len(evidences))}, got {seen.shape}")
    moments = np.zeros((len(points), 3, 3))
    views = np.zeros(len(points), np.int64)
    for evidence, mine in zip(evidences, seen.T, strict=True):
        which = np.flatnonzero(mine)
        camera, count = evidence.camera, len(evidence.support)
        pixels, _ = camera.project(points[which])
        x, y = np.rint(pixels).astype(int).T
        phase = np.exp(2j * np.pi * np.arange(count) / count)
        mean = phase @ evidence.support[:, y, x] / count
        along = 0.5 * np.angle(mean)
        ahead = camera.rays(pixels + np.stack([np.cos(along), np.sin(along)], axis=1))
        normal = np.cross(camera.rays(pixels), ahead)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        weight = np.abs(mean)
        weight = np.where(weight >= least_confidence, np.minimum(weight, 1), 0.0)
        moments[which] += weight[:, None, None] * normal[:, :, None] * normal[:, None, :]
        views[which] += weight > 0
    values = np.sqrt(np.maximum(np.linalg.eigvalsh(moments), 0))
    none = np.zeros(len(points))
    spread = np.divide(values[:, 1], values[:, 2], out=none.copy(), where=views > 1)
    # what rounding leaves of parallel planes says nothing about where they meet
    misfit = np.divide(values[:, 0], values[:, 1], out=none, where=spread > 1e-6)
    return LineConditioning(views, spread, misfit)

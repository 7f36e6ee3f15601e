"""Measured lines that support strands, and the surfaces that cameras see."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from reconstruction.arrays import AnyFloats, Array, Bools, Ints
from reconstruction.geometry.cameras import Camera
from reconstruction.tangents.estimate import Measured

WIDTH = 1e-3
"""Metres: the standard deviation of a line's support across itself, where lines are not denser."""
WIDTHS_APART = 0.8  # the same in distances between measured lines, where they are
REACH = 4.0
"""Widths within which lines support a point."""
ALIKE_DEG = 10.0  # standard deviation of a line's support
GUESSED = 0.05
"""Support up to which a point is guessed."""

_NEIGHBOURS = 6
BLOCK = 1 << 18
"""Points that are looked up together: about 500 bytes each."""


class Lines:
    """Measured lines, looked up by place and direction; `width` in metres (see `WIDTH`)."""

    def __init__(self, lines: Measured, apart: float = np.inf) -> None:
        """`apart` is the distance between neighbouring lines, metres."""
        self.lines = lines
        self.width = min(WIDTH, WIDTHS_APART * apart)
        self._tree = cKDTree(lines.points, balanced_tree=False, compact_nodes=False)

    def near(self, points: AnyFloats) -> tuple[Array, Ints, Bools]:
        """Distances, numbers and whether there is one, each `(N, K)`, of lines within `REACH`."""
        k = np.arange(1, min(_NEIGHBOURS, len(self.lines.points)) + 1)
        reach = REACH * self.width
        distance, index = self._tree.query(points, k=k, distance_upper_bound=reach, workers=-1)
        found = np.isfinite(distance)
        return np.where(found, distance, 0.0), np.where(found, index, 0), found

    def support(self, points: AnyFloats, tangents: AnyFloats) -> Array:
        """How well a measured line agrees with each point `(N, 3)` and its tangent `(N, 3)`.

        `(N,)` in [0, 1]: the largest confidence, attenuated by distance and angle; 0 without a line
        within `REACH`.
        """
        out = np.zeros(len(points))
        for k in range(0, len(points), BLOCK):
            part = slice(k, k + BLOCK)
            distance, index, found = self.near(points[part])
            cosine = np.abs(np.einsum("nki,ni->nk", self.lines.directions[index], tangents[part]))
            turn = np.degrees(np.arccos(np.minimum(cosine, 1.0)))
            alike = np.exp(-0.5 * (distance / self.width) ** 2 - 0.5 * (turn / ALIKE_DEG) ** 2)
            out[part] = np.where(found, self.lines.confidence[index] * alike, 0.0).max(axis=1)
        return out


Surfaces = Sequence[tuple[Camera, Array]]
"""Cameras, each with the depth `(H, W)` of its hair's pixels, 0 elsewhere."""


def near_measured(surfaces: Surfaces, points: AnyFloats, reach: float) -> Surfaces:
    """The `surfaces` within `reach` metres of measured `points (N, 3)`, n > 0; 0 elsewhere.

    Elsewhere no line was measured that could support hair, and a depth is only the envelope's.
    """
    tree = cKDTree(points, balanced_tree=False, compact_nodes=False)
    out = []
    for camera, depth in surfaces:
        y, x = np.nonzero(depth)
        rays = camera.rays(np.stack([x, y], axis=1))
        there = camera.center + rays * (depth[y, x] / (rays @ camera.R[2]))[:, None]
        near, _ = tree.query(there, distance_upper_bound=reach, workers=-1)
        known = np.zeros_like(depth)
        known[y, x] = np.where(np.isfinite(near), depth[y, x], 0)
        out.append((camera, known))
    return out

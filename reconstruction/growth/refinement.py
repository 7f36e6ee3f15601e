"""Joint refinement after growth: strands without coverage of their own go, the rest are moved.

Growth traces strands independently, and many follow the same measured lines. Strands are selected
greedily by the coverage that each adds, then moved onto the measured lines by Gauss-Newton, each
line attracting its nearest strand. Guessed points move behind the visible surface, where the
cameras could not have measured them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import solveh_banded
from scipy.spatial import cKDTree

from reconstruction.arrays import AnyFloats, Array, Bools, Floats, Ints
from reconstruction.geometry.strands import Strands, unit_or_zero
from reconstruction.growth.lines import BLOCK, GUESSED, REACH, Lines, Surfaces, near_measured
from reconstruction.growth.selection import select_by_coverage, without_exposed_ends
from reconstruction.reconstruct_options import RefineOptions
from reconstruction.tangents.estimate import Measured

# Lengths in widths: a line's deviation across itself; behind the visible surface where hair is
# occluded, and the deviation of that; the largest step.
POINT_DEVIATION, BEHIND, BEHIND_DEVIATION, _LARGEST_STEP = 0.5, 1.0, 1.0, 2.0

ANGLE_DEVIATION = np.radians(30.0)
"""Of a measured line of confidence 1: twice its error, as neighbouring lines' errors correlate."""
BEND_DEVIATION = 0.2  # per point, of the change of the turn from one point to the next
GUESS_DEVIATION = 3e-3  # metres, of the displacement of an unsupported point
COMPATIBLE = np.cos(np.radians(35.0))


@dataclass(frozen=True, eq=False)
class Guesses:
    """Points `which (G,)` of strands that no line supports, and the surfaces that cameras see.

    `width` is that of the lines, metres.
    """

    which: Ints
    surfaces: Surfaces
    width: float

    @classmethod
    def of(cls, strands: Strands, lines: Lines, surfaces: Surfaces) -> Guesses:
        """Those of `strands`."""
        support = lines.support(strands.points, strands.tangents())
        return cls(np.flatnonzero(support < GUESSED), surfaces, lines.width)

    def out_of_sight(self, points: AnyFloats) -> Array:
        """Displacement `(G, 3)`, metres, that occludes each guessed one of `points (N, 3)`.

        Along the ray of the camera that needs the largest, to `BEHIND` behind its surface; 0 for
        points that are there already, or more than `REACH` in front of it.
        """
        x = np.asarray(points[self.which], float)
        out, most = np.zeros_like(x), np.zeros(len(x))
        for camera, surface in self.surfaces:
            visible, column, row, depth = camera.pixels_of(x)
            there = surface[row, column]
            front = there - depth
            near = visible & (there > 0) & (front < REACH * self.width)
            short = np.where(near, front + BEHIND * self.width, 0.0)
            more = short > most
            most[more] = short[more]
            out[more] = short[more, None] * unit_or_zero(x[more] - camera.center)
        return out

    def in_front(self, points: AnyFloats) -> float:
        """The share of `points (N, 3)` that are guessed in front of the visible surface."""
        way = np.linalg.norm(self.out_of_sight(points), axis=1)
        return float((way > BEHIND * self.width).sum()) / max(len(points), 1)


def refine(
    strands: Strands,
    measured: Measured,
    options: RefineOptions,
    surfaces: Surfaces = (),
    apart: float = np.inf,
    near: float = np.inf,
) -> tuple[Strands, dict[str, Any]]:
    """Drop the strands that add no coverage and move the others onto the measured lines.

    Guessed points move behind the `surfaces`; lines are `apart` metres from one another. Surfaces
    farther than `near` metres from all lines contradict no strand. Also returns JSON-ready figures.
    At least one line must be measured. Raises `ValueError` where no strand adds
    `options.marginal_coverage`.
    """
    lines = Lines(measured, apart)
    known = near_measured(surfaces, measured.points, near)
    strands = without_exposed_ends(strands, lines, known)
    kept = select_by_coverage(strands, lines, options.marginal_coverage, known)
    if not kept.any():
        raise ValueError(
            f"no strand adds refine.marginal_coverage {options.marginal_coverage:g} per cell: "
            "give less; 0 keeps every strand"
        )
    start = out = strands.subset(kept)
    guesses = Guesses.of(start, lines, surfaces)
    for _ in range(options.steps):
        out = gauss_newton_step(out, start, lines, guesses)
    moved = np.linalg.norm(out.points - start.points, axis=1)
    hair = sum(int((depth > 0).sum()) for _, depth in surfaces)
    figures = {
        "surface_near_lines": sum(int((depth > 0).sum()) for _, depth in known) / max(hair, 1),
        "removed": int((~kept).sum()),
        "strands": len(out),
        "metres_before": float(strands.lengths().sum()),
        "metres": float(out.lengths().sum()),
        "moved_mm": {f"p{q}": float(1e3 * np.percentile(moved, q)) for q in (50, 90, 99)},
        "residuals_before": residuals(start, lines),
        "residuals": residuals(out, lines),
        "guessed_in_front_before": guesses.in_front(start.points),
        "guessed_in_front": guesses.in_front(out.points),
    }
    return out, figures


def supported(strands: Strands, measured: Measured, apart: float = np.inf) -> Floats:
    """Each point's `Strands.confidence (N,)`: `Lines.support`, 0 without any line."""
    if not len(measured.points):
        return np.zeros(len(strands.points), np.float32)
    support = Lines(measured, apart).support(strands.points, strands.tangents())
    return support.clip(0, 1).astype(np.float32)


def residuals(strands: Strands, lines: Lines) -> dict[str, float]:
    """Median distance across (mm) and angle (degrees) of measured lines to the strands.

    Over the lines within `REACH` of a strand; `explained` is their share.
    """
    tree = cKDTree(strands.points, balanced_tree=False, compact_nodes=False)
    distance, index = tree.query(
        lines.lines.points, distance_upper_bound=REACH * lines.width, workers=-1
    )
    found = np.isfinite(distance)
    if not found.any():
        return {"explained": 0.0}
    tangents = strands.tangents()[index[found]]
    off = strands.points[index[found]] - lines.lines.points[found]
    across = off - np.einsum("ni,ni->n", off, tangents)[:, None] * tangents
    cosine = np.abs(np.einsum("ni,ni->n", tangents, lines.lines.directions[found]))
    return {
        "explained": float(found.mean()),
        "across_mm": float(1e3 * np.median(np.linalg.norm(across, axis=1))),
        "angle_deg": float(np.degrees(np.median(np.arccos(np.minimum(cosine, 1.0))))),
    }


def gauss_newton_step(strands: Strands, start: Strands, lines: Lines, guesses: Guesses) -> Strands:
    """One Gauss-Newton step on all points; roots stay.

    A banded solve over `x (N, 3)`: each line attracts its nearest strand point across itself, each
    segment turns to the mean of the lines around it, guessed points move along the ray that sees
    them. The total displacement from `start`, not that of the step, is smooth and small: a prior on
    the step would let strands drift.
    """
    x = strands.points.astype(float)
    tangents = strands.tangents().astype(float)
    n = len(x)
    last = np.zeros(n, bool)
    last[strands.offsets[1:] - 1] = True
    root = strands.offsets[:-1]
    diagonal = np.zeros((3, n, 3, 3))  # blocks between a point and itself, the next, the one after
    eye = np.eye(3)
    diagonal[0] += eye / GUESS_DEVIATION**2
    diagonal[0][root] += eye / 1e-12
    _bend_little(start.points.astype(float), last, diagonal)
    right = -_product(diagonal, x - start.points)
    _hold_to_lines(x, tangents, lines, diagonal[0], right)
    _turn_to_lines(x, tangents, lines, ~last, diagonal, right)
    _hide(x, guesses, diagonal[0], right)
    return replace(
        strands,
        points=(x + _limited(_solve(diagonal, right), _LARGEST_STEP * lines.width)).astype(
            np.float32
        ),
    )


def _hold_to_lines(x: Array, tangents: Array, lines: Lines, own: Array, right: Array) -> None:
    """Each line against its nearest point of compatible tangent, across the line."""
    tree = cKDTree(x, balanced_tree=False, compact_nodes=False)
    reach = REACH * lines.width
    for k in range(0, len(lines.lines.points), BLOCK):
        some = lines.lines.where(slice(k, k + BLOCK))
        p, d, c = some.points, some.directions, some.confidence
        distance, index = tree.query(p, k=np.arange(1, 9), distance_upper_bound=reach, workers=-1)
        found = np.isfinite(distance)
        index = np.where(found, index, 0)
        alike = found & (np.abs(np.einsum("nki,ni->nk", tangents[index], d)) >= COMPATIBLE)
        which = np.flatnonzero(alike.any(axis=1))
        i = index[which, alike[which].argmax(axis=1)]
        across = np.eye(3) - d[which, :, None] * d[which, None, :]
        offset = np.einsum("nij,nj->ni", across, p[which] - x[i])
        # Geman-McClure: lines widths away belong to another strand
        deviation = POINT_DEVIATION * lines.width
        far = (offset**2).sum(axis=1) / (3 * deviation) ** 2
        weight = c[which] / deviation**2 / (1 + far) ** 2
        np.add.at(own, i, weight[:, None, None] * across)
        np.add.at(right, i, weight[:, None] * offset)


def _turn_to_lines(
    x: Array, tangents: Array, lines: Lines, starts: Bools, diagonal: Array, right: Array
) -> None:
    """Each segment against the mean direction of the compatible lines around it."""
    every = np.flatnonzero(starts)
    for k in range(0, len(every), BLOCK):
        i = every[k : k + BLOCK]
        step = x[i + 1] - x[i]
        length = np.linalg.norm(step, axis=1)
        along = unit_or_zero(step)
        distance, index, found = lines.near(0.5 * (x[i] + x[i + 1]))
        d = lines.lines.directions[index]
        cosine = np.einsum("nki,ni->nk", d, along)
        near = np.exp(-0.5 * (distance / lines.width) ** 2) * lines.lines.confidence[index] ** 2
        weight = np.where(found & (np.abs(cosine) >= COMPATIBLE), near, 0.0)
        mean = unit_or_zero(np.einsum("nk,nki->ni", weight * np.sign(cosine), d))
        total = weight.sum(axis=1) / np.maximum(length * ANGLE_DEVIATION, 1e-9) ** 2
        wanted = total[:, None] * (length[:, None] * mean - step)
        block = total[:, None, None] * np.eye(3)
        diagonal[0][i] += block
        diagonal[0][i + 1] += block
        diagonal[1][i] -= block
        right[i] -= wanted
        right[i + 1] += wanted


def _hide(x: Array, guesses: Guesses, own: Array, right: Array) -> None:
    """Each visible guessed point against its occluded position, along the ray."""
    way = guesses.out_of_sight(x)
    ray = unit_or_zero(way)
    own[guesses.which] += (
        ray[:, :, None] * ray[:, None, :] / (BEHIND_DEVIATION * guesses.width) ** 2
    )
    right[guesses.which] += way / (BEHIND_DEVIATION * guesses.width) ** 2


def _bend_little(x: Array, last: Bools, diagonal: Array) -> None:
    """Second differences of the displacement: `u[i] - 2 u[i+1] + u[i+2]` within one strand."""
    i = np.flatnonzero(~last[:-2] & ~last[1:-1])
    length = np.linalg.norm(x[i + 2] - x[i], axis=1) / 2
    weight = (1 / np.maximum(length * BEND_DEVIATION, 1e-9) ** 2)[:, None, None] * np.eye(3)
    for k, own in enumerate((1, 4, 1)):
        diagonal[0][i + k] += own * weight
    diagonal[1][i] -= 2 * weight
    diagonal[1][i + 1] -= 2 * weight
    diagonal[2][i] += weight


def _product(diagonal: Array, x: Array) -> Array:
    """The symmetric block-pentadiagonal matrix times `x (N, 3)`."""
    out = np.einsum("nij,nj->ni", diagonal[0], x)
    for k in (1, 2):
        block = diagonal[k, :-k]
        out[k:] += np.einsum("nij,nj->ni", block, x[:-k])
        out[:-k] += np.einsum("nji,nj->ni", block, x[k:])
    return np.asarray(out)


def _solve(diagonal: Array, right: Array) -> Array:
    """Displacements `(N, 3)` of the block-pentadiagonal system, symmetric positive definite."""
    n = len(right)
    banded = np.zeros((9, 3 * n))
    for block in range(3):
        for a in range(3):
            for b in range(3):
                below = 3 * block + b - a
                if below < 0:
                    continue  # of the diagonal block only the lower half is needed
                banded[below, a::3][: n - block] = diagonal[block, : n - block, b, a]
    return np.asarray(solveh_banded(banded, right.ravel(), lower=True)).reshape(n, 3)


def _limited(step: Array, most: float) -> Array:
    """No point moves further than `most` metres."""
    length = np.linalg.norm(step, axis=1, keepdims=True)
    return step * np.minimum(1.0, most / np.maximum(length, 1e-12))

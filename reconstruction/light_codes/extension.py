"""Strands grown from their tips, half a millimetre at a time, while the views agree (Sun §4.3)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from reconstruction.arrays import Array, Ints
from reconstruction.light_codes.code_views import View

STEP = 5e-4  # metres
ANGLE_DEG = 5.0  # within which a view's line agrees with a strand
LONGEST = 0.05  # metres that grow at most from either tip
LEAST_CONFIDENCE = 0.05  # of a view's line to take part


def fewest_views(count: int) -> int:
    """How many of `count` views must agree: more than a fifth of them, never fewer than three."""
    return max(-(-count // 5) + 1, 3)


def extend(
    views: Sequence[View], strands: list[Array], angle_deg: float = ANGLE_DEG
) -> list[Array]:
    """The polylines `(N, 3)`, extended at both tips.

    The views whose line agrees with the strand's direction at a tip give the next direction
    (Eq. 4); the strand ends where fewer than `fewest_views` agree.
    """
    if not strands:
        return []
    tips = np.concatenate([[s[0] for s in strands], [s[-1] for s in strands]])
    before = np.concatenate(
        [[s[min(2, len(s) - 1)] for s in strands], [s[max(-3, -len(s))] for s in strands]]
    )
    heading = tips - before
    heading /= np.maximum(np.linalg.norm(heading, axis=1, keepdims=True), 1e-12)
    grown = _grow(views, tips, heading, angle_deg)
    n = len(strands)
    return [np.concatenate([grown[k][::-1], s, grown[n + k]]) for k, s in enumerate(strands)]


def _grow(views: Sequence[View], tips: Array, heading: Array, angle_deg: float) -> list[Array]:
    """The points `(n_i, 3)` that follow each tip."""
    columns: list[tuple[Ints, Array]] = []
    active, p, d = np.arange(len(tips)), tips.copy(), heading.copy()
    least = fewest_views(len(views))
    for _ in range(int(LONGEST / STEP)):
        normals, aligned = _planes(views, p, d, angle_deg)
        going = aligned.sum(axis=1) >= least
        if not going.any():
            break
        active, p, d = active[going], p[going], d[going]
        matrix = np.einsum("nv,nvi,nvj->nij", aligned[going], normals[going], normals[going])
        new = np.linalg.eigh(matrix)[1][:, :, 0]
        new *= np.where((new * d).sum(axis=1) < 0, -1.0, 1.0)[:, None]
        straight = (new * d).sum(axis=1) > 0.9  # else planes are nearly parallel
        d = np.where(straight[:, None], new, d)
        p = p + STEP * d
        columns.append((active, p))
    out: list[list[Array]] = [[] for _ in tips]
    for which, points in columns:
        for i, point in zip(which.tolist(), points, strict=True):
            out[i].append(point)
    return [np.array(points).reshape(-1, 3) for points in out]


def _planes(views: Sequence[View], p: Array, d: Array, angle_deg: float) -> tuple[Array, Array]:
    """Normals `(N, V, 3)` of the planes of the lines under `p (N, 3)`, and which run along `d`."""
    normals = np.zeros((len(p), len(views), 3))
    aligned = np.zeros((len(p), len(views)))
    least = np.cos(np.radians(angle_deg))
    for k, view in enumerate(views):
        camera = view.camera
        xy, depth = camera.project(p)
        on = (depth > 0) & camera.inside(xy)
        at = np.rint(np.where(on[:, None], xy, 0)).astype(np.int64)
        line = view.lines[at[:, 1], at[:, 0]].astype(float)
        weight = np.linalg.norm(line, axis=1)
        on &= weight >= LEAST_CONFIDENCE
        M = camera.K @ camera.R
        step = d @ M.T
        flow = step[:, :2] - xy * step[:, 2:]
        cosine = np.abs((flow * line).sum(axis=1))
        norm = np.linalg.norm(flow, axis=1) * weight
        on &= cosine >= least * np.maximum(norm, 1e-300)
        image_line = np.stack(
            [-line[:, 1], line[:, 0], xy[:, 0] * line[:, 1] - xy[:, 1] * line[:, 0]], axis=1
        )
        normal = image_line @ M
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        normals[:, k] = np.where(on[:, None], normal / np.maximum(length, 1e-300), 0.0)
        aligned[:, k] = on
    return normals, aligned

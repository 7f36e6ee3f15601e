"""Strands that follow an orientation field (Photobooth §3.4), and more where it left gaps."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Literal

import numpy as np

from reconstruction.arrays import AnyFloats, Array, Bools, Floats, Ints
from reconstruction.growth.field import OrientationField

Method = Literal["euler", "midpoint", "rk4"]

_TOGETHER = 2000
"""Strands that are traced at once: enough to keep numpy busy, few enough for the caches."""


@dataclass(frozen=True, eq=False)
class Paths:
    """Traced polylines as columns: `points (T, N, 3) float32`, of which path i has `counts[i]`."""

    points: Floats
    counts: Ints


def trace(
    field: OrientationField,
    starts: AnyFloats,
    along: AnyFloats,
    *,
    step: float = 5e-4,
    max_length: float = 0.3,
    method: Method = "midpoint",
) -> Paths:
    """Follow the field from `starts (N, 3)`, setting out on the side of `along (N, 3)`.

    Every `step` metres the line's sign is the one that turns least. A path ends where it leaves
    the envelope or the field has no orientation, and at `max_length` metres. `euler` samples the
    field once a step, `midpoint` twice, `rk4` four times. At half a millimetre `midpoint` is a
    micrometre or two from the field's own line at half of `rk4`'s time, `euler` a tenth of a
    millimetre, in tight curls several (`growth_study.compare_growth`).
    """
    if not step > 0 or not max_length >= step:
        raise ValueError(f"need 0 < step <= max_length, got {step} and {max_length}")
    p = np.asarray(starts, float).copy()
    d, alive = field.sample(p, np.asarray(along, float))
    alive &= field.voxel(p) >= 0
    steps = int(np.ceil(max_length / step))
    rows = [p.astype(np.float32)]
    counts = np.ones(len(p), np.int64)
    active = np.flatnonzero(alive)
    p, d = p[active], d[active]
    for _ in range(steps):
        if not len(active):
            break
        move, good = _advance(field, p, d, step, method)
        q = p + step * move
        d, there = field.sample(q, move)
        good &= there & (field.voxel(q) >= 0)
        active, p, d = active[good], q[good], d[good]
        row = np.zeros((len(starts), 3), np.float32)
        row[active] = p
        rows.append(row)
        counts[active] += 1
    return Paths(np.stack(rows), counts)


def _advance(
    field: OrientationField, p: Array, d: Array, step: float, method: Method
) -> tuple[Array, Bools]:
    """The mean direction `(N, 3)` over one step from `p` where the field points along `d`."""
    if method == "euler":
        return d, np.ones(len(p), bool)
    k2, good = field.sample(p + 0.5 * step * d, d)
    if method == "midpoint":
        return np.where(good[:, None], k2, d), np.ones(len(p), bool)
    k2 = np.where(good[:, None], k2, d)
    k3, good = field.sample(p + 0.5 * step * k2, d)
    k3 = np.where(good[:, None], k3, d)
    k4, good = field.sample(p + step * k3, d)
    k4 = np.where(good[:, None], k4, d)
    return (d + 2 * k2 + 2 * k3 + k4) / 6, np.ones(len(p), bool)


def to_polylines(paths: Paths) -> list[Floats]:
    """The paths as a list of `(n_i, 3)` arrays."""
    columns = np.ascontiguousarray(paths.points.transpose(1, 0, 2))
    return [columns[i, :n] for i, n in enumerate(paths.counts)]


def grow_from_roots(
    field: OrientationField,
    roots: AnyFloats,
    normals: AnyFloats,
    *,
    step: float = 5e-4,
    max_length: float = 0.3,
    lift: float = 12e-3,
    shortest: float = 5e-3,
    to_measured: bool = False,
    method: Method = "midpoint",
    threads: int | None = None,
) -> list[Floats]:
    """Strands from `roots (N, 3)`, setting out along the scalp's `normals (N, 3)`.

    A root whose envelope stays clear of the skin is led to it along the normal, by at most `lift`
    metres. `to_measured` ends a strand at the last measured voxel that it passes and keeps none
    that passes none, as Photobooth §3.4 does; without it they go on, since what a strand passes
    inside the envelope is hair as well. Those shorter than `shortest` metres are not kept.

    Two thousand strands at a time on `threads` (one per core where None), so that memory grows with
    what is kept alone; the strands do not depend on it.
    """
    at: Array = np.asarray(roots, np.float64)
    out_of: Array = np.asarray(normals, np.float64)

    def some(first: int) -> list[Floats]:
        these = slice(first, first + _TOGETHER)
        p, n = at[these], out_of[these]
        starts, found = p.copy(), np.zeros(len(p), bool)
        for height in np.arange(0, lift, step):
            lifted = p + height * n
            new = ~found & (field.voxel(lifted) >= 0) & field.sample(lifted, n)[1]
            starts[new] = lifted[new]
            found |= new
        which = np.flatnonzero(found)
        traced = trace(
            field, starts[which], n[which], step=step, max_length=max_length, method=method
        )
        out = []
        for root, path in zip(p[which].astype(np.float32), to_polylines(traced), strict=True):
            if to_measured:
                path = path[: _last_measured(field, path) + 1]
            if (len(path) - 1) * step < shortest:
                continue
            near = np.linalg.norm(root - path[0]) < step
            out.append(path.copy() if near else np.vstack([root[None], path]))
        return out

    with ThreadPoolExecutor(threads or os.cpu_count()) as pool:
        parts = pool.map(some, range(0, len(at), _TOGETHER))
        return [path for part in parts for path in part]


def _last_measured(field: OrientationField, path: Floats) -> int:
    """Index of the path's last point in a measured voxel, 0 where there is none."""
    number = field.voxel(path)
    return int(np.flatnonzero((number >= 0) & field.measured[number]).max(initial=0))


class Coverage:
    """Which voxels of a field's envelope already hold a strand."""

    def __init__(self, field: OrientationField) -> None:
        self.field = field
        self.covered = np.zeros(len(field.directions), bool)

    def add(self, points: AnyFloats) -> None:
        """Mark the voxels that `points (N, 3)` lie in."""
        n = self.field.voxel(points)
        self.covered[n[n >= 0]] = True

    def gaps(self) -> Ints:
        """Numbers of the voxels with an orientation and no strand."""
        return np.flatnonzero(self.field.valid & ~self.covered)


def fill_gaps(
    field: OrientationField,
    coverage: Coverage,
    *,
    seed: int,
    step: float = 5e-4,
    max_length: float = 0.3,
    shortest: float = 0.01,
    within: float | None = None,
    batch: int = 1500,
    rounds: int = 120,
) -> list[Floats]:
    """Strands through the voxels that no strand passes, traced both ways from random ones.

    Only voxels within `within` metres of a measured one are set out from: Photobooth §3.4 deletes
    strands that meet nothing measured, and the volume between hair and face has no hair. None takes
    3 mm, or two voxels where those are more. Each round
    starts from at most `batch` of the remaining gaps, so that strands of one round cover the seeds
    of the next. Paths shorter than `shortest` metres are not kept.
    """
    rng = np.random.default_rng(seed)
    out: list[Floats] = []
    spent = ~field.near_measured(max(3e-3, 2 * field.grid.spacing) if within is None else within)
    centers = field.grid.centers()
    for _ in range(rounds):
        gaps = coverage.gaps()
        gaps = gaps[~spent[gaps]]
        if not len(gaps):
            break
        chosen = rng.choice(gaps, min(batch, len(gaps)), replace=False)
        spent[chosen] = True
        starts = centers[chosen] + field.grid.spacing * rng.uniform(-0.4, 0.4, (len(chosen), 3))
        d = field.directions[chosen]
        both = trace(
            field, np.tile(starts, (2, 1)), np.vstack([d, -d]), step=step, max_length=max_length
        )
        paths = to_polylines(both)
        for a, b in zip(paths[: len(chosen)], paths[len(chosen) :], strict=True):
            path = np.concatenate([b[:0:-1], a])
            if (len(path) - 1) * step >= shortest:
                out.append(path)
                coverage.add(path)
    return out

"""Strands that follow an orientation field (Photobooth §3.4), and more where it left gaps."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from reconstruction.arrays import AnyFloats, Array, Floats, Ints
from reconstruction.growth.field import OrientationField
from reconstruction.report.report import usable_cores

_LIFT = 12e-3  # metres along the normal within which a root's envelope may begin
_SHORTEST_FROM_ROOT, _SHORTEST_THROUGH_GAP = 5e-3, 10e-3
"""Metres below which strands are dropped; half of `Tracing.max_length` if that is less."""

_ROUNDS = 120

_TOGETHER = 2000
"""Strands traced at once."""


@dataclass(frozen=True)
class Tracing:
    """How a field is followed: midpoint steps of `step` metres, at most `max_length` metres."""

    step: float = 5e-4
    max_length: float = 0.3

    def __post_init__(self) -> None:
        if not self.step > 0 or not self.max_length >= self.step:
            raise ValueError(f"need 0 < step <= max_length, got {self.step} and {self.max_length}")


def trace(
    field: OrientationField, starts: AnyFloats, along: AnyFloats, tracing: Tracing = Tracing()
) -> list[Floats]:
    """Paths `(T, 3)` along the field from `starts (N, 3)`, initially along `along (N, 3)`.

    A path ends where it leaves the envelope or the field has no orientation.
    """
    p = np.asarray(starts, float).copy()
    d, alive = field.sample(p, np.asarray(along, float))
    alive &= field.voxel(p) >= 0
    rows = [p.astype(np.float32)]
    counts = np.ones(len(p), np.int64)
    active = np.flatnonzero(alive)
    p, d = p[active], d[active]
    for _ in range(int(np.ceil(tracing.max_length / tracing.step))):
        if not len(active):
            break
        middle, found = field.sample(p + 0.5 * tracing.step * d, d)
        move = np.where(found[:, None], middle, d)
        q = p + tracing.step * move
        d, there = field.sample(q, move)
        good = there & (field.voxel(q) >= 0)
        active, p, d = active[good], q[good], d[good]
        row = np.zeros((len(starts), 3), np.float32)
        row[active] = p
        rows.append(row)
        counts[active] += 1
    columns = np.stack(rows, axis=1)
    return [columns[i, :n] for i, n in enumerate(counts)]


def grow_from_roots(
    field: OrientationField,
    roots: AnyFloats,
    normals: AnyFloats,
    tracing: Tracing = Tracing(),
    *,
    threads: int | None = None,
) -> list[Floats]:
    """Strands from `roots (N, 3)`, initially along the scalp's `normals (N, 3)`.

    A root up to 12 mm below the envelope is connected to it along the normal. Photobooth §3.4 ends
    a strand at its last measured voxel; here it continues to the end of the envelope. Strands
    shorter than 5 mm, or half of `max_length` if that is less, are dropped. The result does not
    depend on `threads` (one per core by default).
    """
    at: Array = np.asarray(roots, np.float64)
    step = tracing.step
    out_of: Array = np.asarray(normals, np.float64)
    shortest = min(_SHORTEST_FROM_ROOT, tracing.max_length / 2)

    def some(first: int) -> list[Floats]:
        these = slice(first, first + _TOGETHER)
        p, n = at[these], out_of[these]
        starts, found = p.copy(), np.zeros(len(p), bool)
        for height in np.arange(0, _LIFT, step):
            lifted = p + height * n
            new = ~found & (field.voxel(lifted) >= 0) & field.sample(lifted, n)[1]
            starts[new] = lifted[new]
            found |= new
        which = np.flatnonzero(found)
        traced = trace(field, starts[which], n[which], tracing)
        out = []
        for root, path in zip(p[which].astype(np.float32), traced, strict=True):
            if (len(path) - 1) * step < shortest:
                continue
            near = np.linalg.norm(root - path[0]) < step
            out.append(path.copy() if near else np.vstack([root[None], path]))
        return out

    with ThreadPoolExecutor(threads or usable_cores()) as pool:
        parts = pool.map(some, range(0, len(at), _TOGETHER))
        return [path for part in parts for path in part]


class Coverage:
    """Which voxels of a field's envelope already hold a strand."""

    def __init__(self, field: OrientationField) -> None:
        self.field = field
        self.covered = np.zeros(len(field.directions), bool)

    def add(self, points: AnyFloats) -> None:
        """Mark the voxels that `points (N, 3)` lie in."""
        n = self.field.voxel(points)
        self.covered[n[n >= 0]] = True

    def share(self) -> float:
        """Covered share of the voxels with an orientation; 0 without any."""
        valid = self.field.valid
        return float(self.covered[valid].sum() / max(int(valid.sum()), 1))

    def gaps(self) -> Ints:
        """Numbers `(G,)` of the voxels with an orientation and no strand."""
        return np.flatnonzero(self.field.valid & ~self.covered)


def fill_gaps(
    field: OrientationField,
    coverage: Coverage,
    tracing: Tracing = Tracing(),
    *,
    seed: int,
    within: float | None = None,
    batch: int = 1500,
) -> list[Floats]:
    """Strands `(N, 3)` through uncovered voxels, traced both ways from random ones.

    Seeds are voxels within `within` metres of a measured one (None: 3 mm, or two voxels if those
    are more), as Photobooth §3.4 deletes strands that meet nothing measured. Each round starts from
    at most `batch` of the remaining gaps. Paths shorter than 10 mm, or half of `max_length` if that
    is less, are dropped.
    """
    rng = np.random.default_rng(seed)
    out: list[Floats] = []
    consumed = ~field.near_measured(max(3e-3, 2 * field.grid.spacing) if within is None else within)
    centers = field.grid.centers()
    shortest = min(_SHORTEST_THROUGH_GAP, tracing.max_length / 2)
    for _ in range(_ROUNDS):
        gaps = coverage.gaps()
        gaps = gaps[~consumed[gaps]]
        if not len(gaps):
            break
        chosen = rng.choice(gaps, min(batch, len(gaps)), replace=False)
        consumed[chosen] = True
        starts = centers[chosen] + field.grid.spacing * rng.uniform(-0.4, 0.4, (len(chosen), 3))
        d = field.directions[chosen]
        paths = trace(field, np.tile(starts, (2, 1)), np.vstack([d, -d]), tracing)
        for a, b in zip(paths[: len(chosen)], paths[len(chosen) :], strict=True):
            path = np.concatenate([b[:0:-1], a])
            if (len(path) - 1) * tracing.step >= shortest:
                out.append(path)
                coverage.add(path)
    return out

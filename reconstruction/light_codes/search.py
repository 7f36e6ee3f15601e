"""Depth by maximising agreement: two stages, then below a step (Sun §4.2.4 and §4.2.5)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from reconstruction.array_backend import array_types, for_kernels
from reconstruction.arrays import Bools, Floats, Ints
from reconstruction.geometry.cameras import Camera
from reconstruction.light_codes.code_views import View, nearest_views
from reconstruction.light_codes.codes import unpack
from reconstruction.light_codes.device_views import DeviceViews
from reconstruction.light_codes.objective import Line, Pixels, agreement, line_through
from reconstruction.reconstruct_options import SearchOptions

FEW_SAMPLES = 3
"""Points of a segment in the first stage; Sun's compares lightcodes alone there."""

SAMPLES, LENGTH = 13, 5e-3
"""Points of a segment in the second stage, and its length in metres."""

STEP_PIXELS = 5 / 3
"""Largest step between depths, pixels."""

AROUND, FEWEST, LEFT_OUT, BEYOND = 2, 8, 0.1, 1.5e-3
"""Of the lattice: radius of the window that bounds a pixel's depths, fewest depths in it, share
trimmed at either end, and metres added to the rest."""

LEAST_CONFIDENCE = 0.1  # of a reference pixel's line
LEAST_SPREAD = 0.05  # of a segment's planes, else they are nearly parallel


@dataclass(frozen=True, eq=False)
class DepthMap:
    """Depths of one view's reference pixels `(P,)`.

    `x`, `y` integers; `depth` along the camera's axis, metres; `direction (P, 3)`; `agreement` in
    [0, 1]; `spread` and `misfit` as in `objective.Line`; `visible_count` of the neighbours.
    """

    x: Ints
    y: Ints
    depth: Floats
    direction: Floats
    agreement: Floats
    spread: Floats
    misfit: Floats
    visible_count: Ints


class DepthSearch:
    """Searches the depths of every view; holds all views on the device.

    `subject (3,)` is the point by which views count as near one another.
    """

    def __init__(
        self, views: Sequence[View], subject: Any, options: SearchOptions = SearchOptions()
    ) -> None:
        if len(views) < 2:
            raise ValueError(f"line stereo needs at least two views of hair, got {len(views)}")
        self.views, self.options = tuple(views), options
        self.types = array_types()
        self.device = DeviceViews(self.types, views)
        self.neighbours = nearest_views(views, subject, options.neighbours)
        self.steps = [step_of(v.camera, subject, options) for v in views]

    def visible(self, view: int, y: Ints, x: Ints) -> Bools:
        """Which neighbours see the pixels `(P, N)`: a light beside them reaches the pixel.

        A neighbour without a frame of such a light is assumed to see them.
        """
        own = self.views[view]
        words = own.codes.reached[y, x]
        bits = unpack(words, 32 * words.shape[1])
        shot = unpack(own.codes.shot, bits.shape[1])
        sees = [
            bits[:, b] if (b := self.views[k].beside) >= 0 and shot[b] else np.ones(len(x), bool)
            for k in self.neighbours[view]
        ]
        return np.stack(sees, axis=1) if sees else np.zeros((len(x), 0), bool)

    def pixels(self, view: int, y: Ints, x: Ints) -> tuple[Pixels, Ints]:
        """The pixels as lanes, and how many neighbours see each `(P,)`."""
        t, own = self.types, self.views[view]
        visible = self.visible(view, y, x)
        bits = np.left_shift(1, np.arange(1, visible.shape[1] + 1)).astype(np.uint32)
        mask = (visible * bits).sum(axis=1, dtype=np.uint32) | np.uint32(1)
        camera = own.camera
        rays = camera.rays(np.stack([x, y], axis=1))
        rays /= (rays @ camera.R[2])[:, None]
        code = own.codes.words[y, x].T
        order = np.array([view, *self.neighbours[view]], np.uint32)
        lanes = Pixels(
            t.Array3f(*(float(c) for c in camera.center)),
            t.Array3f(*(t.Float(for_kernels(c)) for c in rays.T)),
            [t.UInt32(for_kernels(w, np.uint32)) for w in code],
            dr.opaque(t.UInt32, view),
            t.UInt32(for_kernels(order, np.uint32)),
            t.UInt32(for_kernels(mask, np.uint32)),
        )
        return lanes, visible.sum(axis=1)

    def run(self, view: int, near: Floats, far: Floats) -> DepthMap:
        """Search the reference pixels of `view` between depths `near` and `far (H, W)`, metres.

        Pixels with `far` <= `near` are skipped.
        """
        own = self.views[view]
        wanted = own.mask & (own.confidence >= LEAST_CONFIDENCE) & (far > near)
        apart = self.options.lattice
        if apart == 1:
            return self._among(view, wanted, near, far)
        lattice = np.zeros_like(wanted)
        lattice[apart // 2 :: apart, apart // 2 :: apart] = True
        first = self._among(view, wanted & lattice, near, far)
        nearer, further = narrowed(first, near, far, apart)
        rest = self._among(view, wanted & ~lattice, nearer, further)
        return DepthMap(
            *(np.concatenate([getattr(m, f.name) for m in (first, rest)]) for f in fields(DepthMap))
        )

    def _among(self, view: int, wanted: Bools, near: Floats, far: Floats) -> DepthMap:
        """Search the pixels `wanted (H, W)`."""
        y, x = np.nonzero(wanted)
        if not len(x) or not self.neighbours[view]:
            none, no = np.zeros(0, np.int64), np.zeros(0, np.float32)
            return DepthMap(none, none, no, np.zeros((0, 3), np.float32), no, no, no, none)
        pixels, visible_count = self.pixels(view, y, x)
        start = near[y, x].astype(np.float32)
        counts = np.ceil((far[y, x] - start) / self.steps[view]).astype(np.uint32) + 1
        found = self.search(pixels, x, y, start, counts, view)
        _, _, agree, spread, _ = found
        keep = (visible_count > 0) & (spread >= LEAST_SPREAD) & (agree > 0)
        return DepthMap(*(a[keep] for a in (x, y, *found, visible_count)))

    def search(
        self, pixels: Pixels, x: Any, y: Any, start: Floats, counts: NDArray[np.uint32], view: int
    ) -> tuple[Any, ...]:
        """Depth `(P,)`, direction `(P, 3)`, agreement, spread and misfit `(P,)` of every lane.

        Lane i tries `counts[i]` depths from `start[i]` on.
        """
        t, options = self.types, self.options
        near, number = t.Float(for_kernels(start)), t.UInt32(for_kernels(counts, np.uint32))
        step = dr.opaque(t.Float, self.steps[view])
        fine = _Depths(self.device, pixels, near, step, SAMPLES, LENGTH / (SAMPLES - 1))
        if options.candidates:
            wide = _Depths(self.device, pixels, near, step, FEW_SAMPLES, LENGTH / FEW_SAMPLES)
            score, best = best_of(fine, best_of_all(wide, number, options.candidates)[1])
        else:
            (score,), (best,) = best_of_all(fine, number, 1)
        dr.eval(score, best)
        depth = near + step * t.Float(best)
        before, after = fine.agreement_at(depth - step)[0], fine.agreement_at(depth + step)[0]
        bend = before - 2 * score + after
        shift = dr.select(bend < 0, 0.5 * (before - after) / dr.minimum(bend, -1e-12), 0)
        depth += step * dr.clip(shift, -0.5, 0.5)
        agree, line = fine.agreement_at(depth)
        return fetched(depth, line.direction, agree, line)


def step_of(camera: Camera, subject: Any, options: SearchOptions) -> float:
    """Metres between a view's depths: the option's, or less where its pixels are fine."""
    pixel = np.linalg.norm(camera.center - np.asarray(subject, float)) / camera.K[0, 0]
    return min(options.step, float(STEP_PIXELS * pixel))


def narrowed(found: DepthMap, near: Floats, far: Floats, apart: int) -> tuple[Floats, Floats]:
    """`near` and `far (H, W)`, narrowed to the depths `found` on a lattice of spacing `apart`.

    Trimmed range of the lattice's depths around a pixel, plus `BEYOND`; unchanged where fewer than
    `FEWEST` are known.
    """
    shape = -(-near.shape[0] // apart), -(-near.shape[1] // apart)
    depths = np.full(shape, np.nan, np.float32)
    depths[found.y // apart, found.x // apart] = found.depth
    around = np.lib.stride_tricks.sliding_window_view(
        np.pad(depths, AROUND, constant_values=np.nan), (2 * AROUND + 1,) * 2
    ).reshape(*shape, -1)
    around = np.sort(around, axis=-1)  # NaN comes last
    count = np.isfinite(around).sum(axis=-1)
    few = count < FEWEST
    left_out = (LEFT_OUT * count).astype(np.int64)

    def ranked(rank: Ints) -> Floats:
        rank = np.clip(rank, 0, None)[..., None]
        return np.asarray(np.take_along_axis(around, rank, axis=-1)[..., 0], np.float32)

    low = np.where(few, -np.inf, ranked(left_out) - BEYOND)
    high = np.where(few, np.inf, ranked(count - 1 - left_out) + BEYOND)
    y, x = np.arange(near.shape[0]) // apart, np.arange(near.shape[1]) // apart
    low, high = np.maximum(near, low[np.ix_(y, x)]), np.minimum(far, high[np.ix_(y, x)])
    out = low >= high
    return np.where(out, near, low), np.where(out, far, high)


def fetched(depth: Any, direction: Any, agreement: Any, line: Line) -> tuple[Any, ...]:
    """What `DepthSearch.search` returns, as NumPy's arrays."""
    dr.eval(depth, direction, agreement, line.spread, line.misfit)
    spread, misfit = line.spread.numpy(), line.misfit.numpy()
    return depth.numpy(), direction.numpy().T.copy(), agreement.numpy(), spread, misfit


class _Depths:
    """Depths of the `pixels`: number k is `near + k step`; no dataclass, as `Pixels`.

    Segments are compared at `samples` points, `apart` metres apart.
    """

    def __init__(
        self, device: DeviceViews, pixels: Pixels, near: Any, step: Any, samples: int, apart: float
    ) -> None:
        self.device, self.types, self.pixels = device, device.types, pixels
        self.near, self.step = near, step
        self.samples = dr.opaque(self.types.UInt32, samples)
        self.apart = dr.opaque(self.types.Float, apart)

    def agreement_at(self, depth: Any) -> tuple[Any, Any]:
        """The agreement at `depth` and the line that has it."""
        point = self.pixels.at(depth)
        line = line_through(self.device, self.pixels, point)
        along = self.apart * line.direction
        return agreement(self.device, self.pixels, point, along, self.samples), line

    def agreement_of(self, number: Any) -> Any:
        """The agreement at a depth by its number."""
        return self.agreement_at(self.near + self.step * self.types.Float(number))[0]


@dr.syntax
def best_of_all(depths: _Depths, number: Any, count: int) -> tuple[list[Any], list[Any]]:
    """The `count` best depths below `number`: agreements and numbers, an array for each rank."""
    t = depths.types
    scores = [t.Float(-1) for _ in range(count)]
    steps = [t.UInt32(0) for _ in range(count)]
    k = t.UInt32(0)
    while k < number:
        here = depths.agreement_of(k)
        moved = k
        for i in range(count):  # insertion into the sorted list, without a branch
            better = here > scores[i]
            old_score, old_step = scores[i], steps[i]
            scores[i] = dr.select(better, here, old_score)
            steps[i] = dr.select(better, moved, old_step)
            here = dr.select(better, old_score, here)
            moved = dr.select(better, old_step, moved)
        k += 1
    return scores, steps


def best_of(depths: _Depths, steps: list[Any]) -> tuple[Any, Any]:
    """The best agreement over the depths numbered `steps`, and its number."""
    dr.eval(steps)
    width = dr.opaque(depths.types.UInt32, dr.width(steps[0]))
    return _best_listed(depths, dr.concat(steps), width, len(steps))


@dr.syntax
def _best_listed(depths: _Depths, table: Any, width: Any, count: int) -> tuple[Any, Any]:
    t = depths.types
    lane = dr.arange(t.UInt32, len(depths.near))
    score, best = t.Float(-1), t.UInt32(0)
    i = t.UInt32(0)
    while i < count:
        k = dr.gather(t.UInt32, table, i * width + lane)
        here = depths.agreement_of(k)
        better = here > score
        score = dr.select(better, here, score)
        best = dr.select(better, k, best)
        i += 1
    return score, best

"""A fit's data and its two questions: how far off is a guess, and which way is down."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance.bsdf.maps import HairMaps, MappedStrands
from appearance.inverse_rendering import losses
from appearance.inverse_rendering.batches import Batch, Pairs, Seen
from appearance.inverse_rendering.unknowns import Lamps, Raw, hair_values, maps_of, raw_of
from appearance.observations import Observed
from appearance.render.differentiable import DifferentiableOlat
from appearance.render.olat import render_olat
from appearance.scene.hair_scene import HairScene
from reconstruction.array_backend import for_kernels
from reconstruction.arrays import Array, Ints
from reconstruction.geometry.lights import Light

Watched = Sequence[tuple[Batch, Ints, Array]]
"""Pairs, the numbers of some of their pixels, and the share of its weight that each keeps."""


@dataclass(frozen=True)
class Effort:
    """What one step may cost: `pixels` of a view, paths a pixel of at most `max_depth` vertices.

    The picture gets more paths (`spp`) than its gradient (`gradient_spp`): they cost an eighth, and
    the picture's noise multiplies the gradient's. Few steps of many paths beat many of few.
    """

    pixels: int = 600
    spp: int = 128
    gradient_spp: int = 16
    max_depth: int = 8
    rr_depth: int = 3


@dataclass(frozen=True, eq=False)
class Slope:
    """A batch's gradient by each of the free numbers, and what it saw."""

    gradient: Raw
    seen: Seen


class Problem:
    """Hair pixels of `views` under `lights`, the geometry, and the exposure `scale`.

    All views have the same lights. Rendered and captured values are in exposure units here.
    """

    def __init__(
        self, mapped: MappedStrands, views: Sequence[Observed], scale: float, skin: Array
    ) -> None:
        self.mapped, self.views, self.scale, self.skin = mapped, tuple(views), scale, skin
        self.lights: tuple[Light, ...] = views[0].lights if views else ()
        self._painted: HairScene | None = None
        self._level = [
            losses.level(o.radiance.astype(float) * scale).astype(np.float32) for o in self.views
        ]
        profiles = list({id(x.profile): 0 for x in self.lights})
        self.profile_of = np.array([profiles.index(id(x.profile)) for x in self.lights], np.int64)

    def raw_of(self, maps: HairMaps, lamps: Lamps) -> Raw:
        """The unconstrained numbers of `maps` and `lamps`."""
        return raw_of(maps, lamps, self.profile_of)

    def slope(
        self,
        raw: Raw,
        gain: Array,
        free: Sequence[str],
        batch: Batch,
        effort: Effort,
        seeds: tuple[int, int],
        rng: np.random.Generator,
        *,
        loss: str = "squares",
        lambdas: tuple[float, float] = (0.0, 0.0),
        error: float = 1.0,
        repeatable: bool = True,
    ) -> Slope:
        """The derivative of the loss of a batch; `seeds` are the picture's and the gradient's.

        `error` is about what `error` says, for the root of squares.
        Threads add up a gradient in no fixed order: a `repeatable` one takes a single thread.
        """
        o = self.views[batch.view]
        few = np.sort(rng.permutation(len(o.pixels))[: effort.pixels])
        leaves = {k: mi.TensorXf(for_kernels(v)) for k, v in raw.items()}
        for name in free:
            dr.enable_grad(leaves[name])
        seen = self.seen(batch, few, self.render(raw, gain, batch, few, effort, seeds[0]))
        difference = seen.rendered - seen.captured
        weight = losses.slope(difference, seen.level, seen.valid, loss, error)
        # a pair's loss is its mean over pixels; slope() took the mean over pairs too
        weight *= batch.share[:, None, None] * len(batch.lights) * self.scale
        op = self._op(raw, gain, batch, few, effort)
        values = hair_values(leaves) | self._lamp_values(op, leaves, free, batch.lights)
        known = op.parameters() | {k: dr.detach(v) for k, v in values.items()}
        wanted = [k for k, v in values.items() if dr.grad_enabled(v)]
        with _threads(1 if repeatable else None):
            found = op.gradients(known, wanted, mi.TensorXf(for_kernels(weight)), seeds[1])
            dr.eval(found)
        total = losses.smoothness(values, *lambdas)
        for name in wanted:
            total = total + dr.sum(found[name] * values[name], axis=None)
        dr.backward(total)
        gradient = {k: np.array(dr.grad(leaves[k]), float) for k in free}
        return Slope(gradient, seen)

    def error(self, raw: Raw, gain: Array, watched: Watched, effort: Effort, seed: int) -> float:
        """Weighted mean squared difference, noise taken off, with fixed random numbers."""
        values = []
        for batch, few, quiet in watched:
            a, b = self._twice(raw, gain, batch, few, effort, seed)
            values.append(
                losses.squares(
                    a.rendered - a.captured,
                    b.rendered - b.captured,
                    quiet * losses.weights(0.5 * (a.level + b.level)),
                    a.valid,
                )
            )
        return float(np.mean(values)) if values else 0.0

    def watched(
        self, raw: Raw, gain: Array, pairs: Sequence[Batch], effort: Effort, seed: int
    ) -> Watched:
        """What `error` looks at: some pixels of `pairs`, and how quiet they are about `raw`."""
        out = []
        for batch in pairs:
            count = len(self.views[batch.view].pixels)
            few = np.sort(np.random.default_rng(seed).permutation(count)[: effort.pixels])
            a, b = self._twice(raw, gain, batch, few, effort, seed + (1 << 22))
            weight = np.where(a.valid[..., None], losses.weights(0.5 * (a.level + b.level)), 0)
            quiet = losses.quieted(weight, (a.rendered - b.rendered) ** 2)
            share = np.divide(quiet, weight, out=np.zeros_like(weight), where=weight > 0)
            out.append((batch, few, share))
        return out

    def _twice(
        self,
        raw: Raw,
        gain: Array,
        batch: Batch,
        few: Ints,
        effort: Effort,
        seed: int,
    ) -> tuple[Seen, Seen]:
        """Two independent pictures beside what was captured."""
        one, other = (self.render(raw, gain, batch, few, effort, seed + k) for k in (0, 1 << 20))
        return self.seen(batch, few, one), self.seen(batch, few, other)

    def seen(self, batch: Batch, few: Ints, rendered: Array) -> Seen:
        """`rendered (k, P, 3)` beside what was captured of a view's pixels number `few`."""
        o = self.views[batch.view]
        captured = o.radiance[batch.lights][:, few].astype(float) * self.scale
        level = self._level[batch.view][batch.lights][:, few].astype(float)
        # weights at the middle of both make squares those of displayed differences, large ones too
        level = 0.5 * (level + losses.level(rendered))
        return Seen(rendered, captured, level, o.valid[batch.lights][:, few])

    def render(
        self,
        raw: Raw,
        gain: Array,
        batch: Batch,
        few: Ints,
        effort: Effort,
        seed: int,
    ) -> Array:
        """A view's pixels number `few` under some lights, in exposure units `(k, P, 3)`."""
        moved = self.lamps_at(raw, gain)
        o = self.views[batch.view]
        radiance = render_olat(
            self._scene(raw),
            o.camera,
            [moved[i] for i in batch.lights],
            spp=effort.spp,
            max_depth=effort.max_depth,
            thrift=0,
            seed=seed,
            pixels=o.pixels[few],
        )
        return radiance.astype(float) * self.scale

    def lamps_at(self, raw: Raw, gain: Array) -> list[Light]:
        """All lights as `raw` has them."""
        profile = np.exp(raw["profile"])[self.profile_of]
        return Lamps(raw["position"], raw["turn"], gain, profile).of(self.lights)

    def spread(self, pairs: Pairs, views: int, images: int) -> list[Batch]:
        """Some views and lights, spread evenly over what is used."""
        usable = np.flatnonzero(pairs.used.any(axis=1))
        out = []
        for view in usable[:: max(1, len(usable) // views)][:views]:
            lights = np.flatnonzero(pairs.used[view])
            lights = lights[:: max(1, -(-len(lights) // images))]
            out.append(Batch(int(view), lights, np.ones(len(lights))))
        return out

    def _scene(self, raw: Raw) -> HairScene:
        """The one scene of this problem, as `raw` has it."""
        maps = maps_of(raw)
        if self._painted is None:
            self._painted = self.mapped.painted(maps).with_skin(self.skin)
        self._painted = self.mapped.repainted(self._painted, maps)
        return self._painted

    def _op(
        self, raw: Raw, gain: Array, batch: Batch, few: Ints, effort: Effort
    ) -> DifferentiableOlat:
        scene = self._scene(raw)
        moved = self.lamps_at(raw, gain)
        o = self.views[batch.view]
        return DifferentiableOlat(
            scene,
            o.camera,
            [moved[i] for i in batch.lights],
            o.pixels[few],
            spp=effort.gradient_spp,
            max_depth=effort.max_depth,
            rr_depth=effort.rr_depth,
        )

    def _lamp_values(
        self,
        op: DifferentiableOlat,
        leaves: dict[str, Any],
        free: Sequence[str],
        lights: Ints,
    ) -> dict[str, Any]:
        """The lamps of a batch as functions of the leaves; the op's lamps are already moved."""
        out: dict[str, Any] = {}
        known = op.parameters()
        rows = (lights[:, None] * 3 + np.arange(3)).ravel()
        for name, parameter in (("position", "lamps.position"), ("turn", "lamps.turn")):
            if name in free:
                moved = dr.gather(
                    mi.Float, leaves[name].array, mi.UInt32(for_kernels(rows, np.uint32))
                )
                moved = moved - dr.detach(moved)
                out[parameter] = known[parameter] + mi.TensorXf(moved, (len(lights), 3))
        if "profile" in free:
            which = np.repeat(self.profile_of[lights], 3).astype(np.uint32)
            factor = dr.gather(mi.Float, leaves["profile"].array, mi.UInt32(which))
            factor = dr.exp(factor - dr.detach(factor))
            intensity = known["lamps.intensity"]
            out["lamps.intensity"] = intensity * mi.TensorXf(factor, (len(lights), 3))
        return out


@contextmanager
def _threads(count: int | None) -> Iterator[None]:
    """Dr.Jit with `count` threads (None: as it is); no kernel runs while that changes."""
    before = dr.thread_count()
    dr.sync_thread()
    dr.set_thread_count(count or before)
    try:
        yield
    finally:
        dr.sync_thread()
        dr.set_thread_count(before)

"""One-light-at-a-time images: each camera path is traced once for many lights."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from appearance.render.bounces import bounce_limit
from appearance.render.coverage import covered_pixels
from appearance.render.lights import LightBank
from appearance.render.paths import PointSource, Surface, light_from, pixel_indices
from appearance.render.tracing import LANE_BYTES, PathLimits, PathPlan, Paths, follow
from appearance.scene.hair_scene import HairScene
from appearance.scene.opaque import opaque_index
from reconstruction import Camera, Light
from reconstruction.arrays import Floats, Ints

_PILOT = 512  # pixels of the pilot passes at most
_PILOT_SHARE = 64  # and one path in so many
_PILOT_STREAM = 1 << 31
_USUAL = 0.99  # quantile of the pilot's pixels beyond which a path is a rare bright one


@dataclass(frozen=True)
class OlatOptions:
    """How `render_olat` spends its time.

    `spp` paths a pixel serve all lights. `max_depth` is the number of vertices a path may have (1
    is direct light); None measures what is needed, see `bounce_limit`.

    Every vertex weighs all lights, or a systematic sample of `first_lights` at the first vertex
    and `deep_lights` at later ones, weighted by L/k: worse for images of single lights, better for
    their sum. A contribution below `thrift` times the standard deviation of what a path brings
    from that light (from a pilot pass) casts its shadow ray by roulette; 0 casts all of them. A
    shadow ray takes as long as the BSDF of twenty lights: 3 halves the time and more for 5 to 10 %
    more variance on hair, where 2 to 8 do as well within a tenth. The estimate is unbiased for
    every choice of these numbers.

    `memory` bounds, in bytes, what the tiles of pixels take at a time; the images that
    `render_olat` returns come on top.
    """

    spp: int = 32
    max_depth: int | None = None
    first_lights: int | None = None
    deep_lights: int | None = None
    thrift: float = 3.0
    memory: int = 1 << 30

    def __post_init__(self) -> None:
        counts = (self.first_lights, self.deep_lights, self.max_depth)
        if min(self.spp, self.memory, *(1 if n is None else n for n in counts)) < 1:
            raise ValueError(
                "spp, max_depth, first_lights, deep_lights and memory must be positive, got "
                f"{self.spp}, {self.max_depth}, {self.first_lights}, {self.deep_lights}, "
                f"{self.memory}"
            )
        if not self.thrift >= 0:
            raise ValueError(f"thrift must be 0 or more, got {self.thrift}")


def render_olat(
    scene: HairScene,
    camera: Camera,
    lights: Sequence[Light],
    *,
    seed: int = 0,
    pixels: ArrayLike | None = None,
    **options: Any,
) -> Floats:
    """Radiance under each of `lights` alone, W/(sr m²) at full level.

    Returns `(L, P, 3)` for `pixels (P,)` (flat indices), or `(L, H, W, 3)` without `pixels`: then
    a cheap pass finds the pixels that see the subject and only those are traced. `options` are
    those of `OlatOptions`. Same arguments, same bytes, with any number of threads.
    Raises `ValueError` for options out of range.
    """
    chosen = OlatOptions(**options)
    index = covered_pixels(scene, camera) if pixels is None else pixel_indices(camera, pixels)
    size = camera.height * camera.width if pixels is None else len(index)
    out = np.zeros((len(lights), size, 3), np.float32)
    for part, radiance in _tiles(scene, camera, lights, index, chosen, seed):
        out[:, index[part] if pixels is None else part] = radiance
    return out if pixels is not None else out.reshape(-1, camera.height, camera.width, 3)


def _tiles(
    scene: HairScene,
    camera: Camera,
    lights: Sequence[Light],
    index: Ints,
    options: OlatOptions,
    seed: int,
) -> Iterator[tuple[slice, Floats]]:
    """Slices of `index`, each spread over the whole image, and the radiance `(L, P, 3)` there."""
    if not len(lights) or not len(index):
        return
    plan = _plan(scene, camera, lights, index, options, seed)
    # the film, its copy and the mean
    each = 3 * 12 * len(lights) + LANE_BYTES
    tiles = -(-len(index) // max(1, options.memory // each))
    for k in range(tiles):
        part = slice(k, None, tiles)
        yield part, _render_tile(scene, camera, index[part], options.spp, plan, (seed, k))


@dataclass(frozen=True)
class _Plan:
    """How paths and shadow rays are spent.

    `counts`: lights asked at the first and at later vertices. `dim (L,)`: contributions below this
    radiance cast their shadow ray with a probability in proportion.
    """

    lights: Sequence[Light]
    counts: tuple[int, int]
    limits: PathLimits
    dim: Floats


def _plan(
    scene: HairScene,
    camera: Camera,
    lights: Sequence[Light],
    index: Ints,
    options: OlatOptions,
    seed: int,
) -> _Plan:
    wanted = (options.first_lights, options.deep_lights)
    first, deep = (len(lights) if n is None else min(n, len(lights)) for n in wanted)
    depth = options.max_depth
    if depth is None:
        depth = bounce_limit(scene, camera, pixels=index, seed=seed).depth
    none = np.zeros(len(lights), np.float32)
    plan = _Plan(lights, (first, deep), PathLimits(depth), none)
    if options.thrift > 0:
        spread = _spread(scene, camera, index, options.spp, plan, seed)
        plan = replace(plan, dim=np.float32(options.thrift) * spread)
    return plan


def _spread(
    scene: HairScene,
    camera: Camera,
    index: Ints,
    spp: int,
    plan: _Plan,
    seed: int,
) -> Floats:
    """Standard deviation `(L,)` of what a path through a pixel brings from each light.

    From a few paths, and without the brightest of them: a rare bright path, a hundred times what
    all others bring, is no measure for these.
    """
    wanted = int(np.clip(len(index) * spp // _PILOT_SHARE, 64, _PILOT))
    few = index[:: -(-len(index) // wanted)]

    def pilot(pixels: Ints, plan: _Plan, number: int) -> Floats:
        radiance = _render_tile(scene, camera, pixels, 1, plan, (seed, _PILOT_STREAM + number))
        brightest = radiance.max(-1)
        return np.minimum(brightest, np.quantile(brightest, _USUAL, axis=1, keepdims=True))

    # the mean of fewer still, with every shadow ray, is enough to spare most of them in the rest
    sparing = replace(plan, dim=pilot(few[::8], plan, 0).mean(1))
    one, other = np.split(pilot(np.concatenate([few, few]), sparing, 1), 2, axis=1)
    return np.asarray(np.sqrt(((one - other) ** 2).mean(1) / 2), np.float32)


def _render_tile(
    scene: HairScene,
    camera: Camera,
    index: Ints,
    spp: int,
    plan: _Plan,
    seed: tuple[int, int],
) -> Floats:
    """Mean over `spp` paths a pixel: `(L, P, 3)`."""
    lights = plan.lights
    film = dr.zeros(mi.Float, 3 * len(lights) * len(index))
    surface = Surface(scene)
    gather = _Gather(surface, film, opaque_index(len(index)), _Bank.of(lights, plan.dim), plan)
    follow(surface, camera, index, PathPlan(spp, seed, plan.limits), gather)
    image = np.array(film).reshape(len(lights), 3, len(index)).transpose(0, 2, 1)
    return np.asarray(image / np.float32(spp), dtype=np.float32)


@dataclass(frozen=True)
class _Bank:
    """The lights on the device, and the contributions `(L,)` below which roulette is played."""

    lights: LightBank
    dim: Any

    @classmethod
    def of(cls, lights: Sequence[Light], dim: Floats) -> _Bank:
        return cls(LightBank.of(lights), mi.Float(dim))


@dataclass(frozen=True)
class _Gather:
    """Light from the bank, or a systematic sample of it, at a path's vertex."""

    surface: Surface
    film: Any
    slots: Any
    bank: _Bank
    plan: _Plan

    def __call__(self, si: Any, paths: Paths) -> None:
        total, first = self.bank.lights.count, paths.depth == 0
        active = paths.active
        count = dr.select(first, *(opaque_index(n) for n in self.plan.counts))
        stride = mi.Float(total) / mi.Float(count)
        sampled = min(self.plan.counts) < total
        start = paths.rng.next_float32() * stride if sampled else mi.Float(0)

        def more(j: Any, rng: Any) -> Any:
            return active & (j < count)

        def body(j: Any, rng: Any) -> Any:
            light = j
            if sampled:
                light = dr.minimum(mi.UInt32(mi.Float(j) * stride + start), total - 1)
            self._add(si, paths, stride, light, rng, active)
            return j + 1, rng

        dr.while_loop((mi.UInt32(0), paths.rng), more, body, label="lights of a vertex")

    def _add(self, si: Any, paths: Paths, weight: Any, light: Any, rng: Any, active: Any) -> None:
        target, intensity = self.bank.lights.sample(light, si.p, rng, active)
        value, lit = light_from(
            self.surface,
            si,
            paths.throughput * weight,
            PointSource(target, intensity, dr.gather(mi.Float, self.bank.dim, light, active)),
            rng.next_float32(),
            active,
        )
        for channel in range(3):
            put = (light * 3 + channel) * self.slots + paths.slot
            dr.scatter_add(self.film, value[channel], put, lit, mode=dr.ReduceMode.NoConflicts)

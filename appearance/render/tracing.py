"""One loop over all camera paths: a lane whose path ends begins its next."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Any

import drjit as dr
import mitsuba as mi
import numpy as np
from pydantic import Field

from appearance.render.paths import Surface, jittered, seed_state, stream_of
from appearance.scene.opaque import opaque, opaque_index
from reconstruction import Camera
from reconstruction.array_backend import for_kernels
from reconstruction.arrays import Bools, Floats, Ints
from reconstruction.options import Count, options

_log = logging.getLogger(__name__)

LANE_BYTES = 512
"""Approximate memory of a path."""


@options
class PathLimits:
    """Limits of a path.

    `max_depth`: most vertices. `roulette`: throughput (largest channel) below which a path
    survives with probability throughput/`roulette`; 0 disables it. On blond and on black hair 0.5
    costs least for the same error; 0.3 to 1 is within a sixth of it.
    """

    max_depth: Count
    roulette: Annotated[float, Field(ge=0)] = 0.5


@options
class Sampling:
    """Paths a pixel, vertices a path at most, and the seed of an image."""

    spp: Count = 64
    max_depth: Count = 24
    seed: int = 0

    def plan(self) -> PathPlan:
        """The paths of an image in one piece."""
        return PathPlan(self.spp, (self.seed,), PathLimits(self.max_depth))


SAMPLING = Sampling()


@dataclass(frozen=True)
class PathPlan:
    """`spp` paths a pixel within `limits`, their random numbers from `seeds`."""

    spp: int
    seeds: tuple[int, ...]
    limits: PathLimits


@dataclass(frozen=True)
class Paths:
    """One step of the paths in flight, all Dr.Jit variables.

    `throughput` (`Color3f`) is the product of weights so far, `depth` counts the vertices so far,
    `slot` is the lane's place in the list of pixels, `rng` its random stream. Lanes that are not
    `active` are to be left alone.
    """

    throughput: Any
    depth: Any
    slot: Any
    rng: Any
    active: Any


def follow(
    surface: Surface,
    camera: Camera,
    pixels: Ints,
    plan: PathPlan,
    vertex: Callable[[Any, Paths], None],
    escape: Callable[[Any, Paths], None] | None = None,
) -> None:
    """Follow `plan.spp` paths through each of the flat `pixels (P,)`.

    `vertex(si, paths)` is called at hits and `escape(ray, paths)` for rays that miss the subject;
    both are traced once, with symbolic variables, and add to films. All samples of a pixel are one
    lane's, in order, so that sums are the same on every run. Lanes do not wait for each other's
    longest path, which saves a fifth to a third of the time.
    """
    spp, limits = plan.spp, plan.limits
    slot = dr.arange(mi.UInt32, len(pixels))
    pixel = mi.UInt32(for_kernels(pixels, np.uint32))
    size, end, last = opaque_index(len(pixels)), opaque_index(spp), opaque_index(limits.max_depth)
    (roulette,) = opaque(limits.roulette)
    origin = seed_state(*plan.seeds)

    def begin(sample: Any) -> tuple[Any, Any]:
        lane = mi.UInt64(sample) * mi.UInt64(size) + mi.UInt64(slot)
        rng = stream_of(origin, lane)
        return rng, jittered(camera, pixel, sample, spp, rng)

    def more(ray: Any, throughput: Any, depth: Any, sample: Any, rng: Any, active: Any) -> Any:
        return active

    def body(ray: Any, throughput: Any, depth: Any, sample: Any, rng: Any, active: Any) -> Any:
        si = surface.interact(ray, active)
        hit = active & si.is_valid()
        if escape is not None:
            escape(ray, Paths(throughput, depth, slot, rng, active & ~hit))
        vertex(si, Paths(throughput, depth, slot, rng, hit))

        u1, u2 = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
        wo, weight = surface.sample(si, u1, u2, hit)
        throughput = throughput * weight
        strength = dr.max(throughput)
        survival = dr.select(strength < roulette, strength / roulette, 1)
        alive = hit & (strength > 0) & (depth + 1 < last) & (rng.next_float32() < survival)

        following = si.spawn_ray(si.to_world(wo))
        sample = dr.select(alive, sample, sample + 1)
        other_rng, other_ray = begin(sample)
        return (
            dr.select(alive, following, other_ray),
            dr.select(alive, throughput * dr.rcp(survival), mi.Color3f(1)),
            dr.select(alive, depth + 1, 0),
            sample,
            dr.select(alive, rng, other_rng),
            sample < end,
        )

    first = dr.zeros(mi.UInt32, len(pixels))
    rng, ray = begin(first)
    start = (ray, mi.Color3f(1), dr.zeros(mi.UInt32, len(pixels)), first, rng, first < end)
    dr.while_loop(start, more, body, label="paths")


def add_light(film: Any, value: Any, first: Any, active: Any, stride: Any = 1) -> None:
    """Add the channels of `value` at `first`, `first + stride`, …, which no other lane writes."""
    for channel in range(3):
        put = first + channel * stride
        dr.scatter_add(film, value[channel], put, active, mode=dr.ReduceMode.NoConflicts)


def tile_count(pixels: Ints, each: int, memory: int) -> int:
    """In how many tiles to render `pixels (P,)`, which take `each` bytes beside a path's."""
    return -(-len(pixels) // max(1, memory // (each + LANE_BYTES)))


def render_whole(
    camera: Camera,
    index: Ints,
    image: Floats,
    render: Callable[[Ints, PathPlan], None],
    plan: PathPlan,
) -> None:
    """Have `render` write the flat pixels `index (P,)` of `image (H W, 3)`; see `render_again`."""
    if not len(index):
        return

    def again(bad: Ints) -> None:
        render(index[bad], replace(plan, seeds=(*plan.seeds, 1)))

    def finite() -> Bools:
        return np.asarray(np.isfinite(image[index]).all(axis=1))

    render(index, plan)
    render_again(camera, index, finite, again, plan.seeds[0])


def render_again(
    camera: Camera,
    index: Ints,
    finite: Callable[[], Bools],
    again: Callable[[Ints], None],
    seed: int,
) -> None:
    """Render the pixels of `index (P,)` once more whose light is not finite, a rare float error.

    `finite` returns a flag per pixel, `again` renders those at some places of `index`. Raises
    `FloatingPointError` if light stays infinite.
    """
    bad = np.flatnonzero(~finite())
    if not len(bad):
        return
    where = f"{camera.name}: light is not finite in pixels {index[bad][:10].tolist()}"
    _log.warning("%s, seed %d; they are rendered again", where, seed)
    again(bad)
    if not finite().all():
        raise FloatingPointError(f"{where}, twice: check the strands and lights there")

"""One-light-at-a-time images: each camera path is traced once for many lights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from appearance.render.bounces import bounce_limit
from appearance.render.coverage import covered_pixels
from appearance.render.lights import PackedLights
from appearance.render.paths import (
    PointSource,
    Surface,
    light_from,
    pixel_indices,
    stream_of,
    unshadowed,
)
from appearance.render.pixel_field import field_of
from appearance.render.tracing import (
    PathLimits,
    PathPlan,
    Paths,
    add_light,
    follow,
    render_again,
    tile_count,
)
from appearance.scene.hair_scene import HairScene
from appearance.scene.opaque import opaque_index
from reconstruction import Camera, Light
from reconstruction.arrays import Bools, Floats, Ints
from reconstruction.geometry.lights import Lighting, components, mixed
from reconstruction.options import Count, options

_PILOT = 512  # pixels of the pilot passes at most
_PILOT_SHARE = 64  # and one path in so many
_PILOT_STREAM = 1 << 31
FILM_BYTES = 3 * 12
"""Of a pixel under a light: the film, its copy and the mean."""
_BLOCK = 32
"""Lights of which a vertex chooses those that cast a shadow ray: the bits of an integer."""
_USUAL = 0.99  # quantile of the pilot's pixels beyond which a path is a rare bright one


@options
class OlatOptions:
    """Sampling of `render_olat`, unbiased for every choice.

    `spp` paths a pixel are shared by all lights. `max_depth` is the largest number of vertices (1
    is direct light); None measures it, see `bounce_limit`.

    Every vertex gathers all lights, or a systematic sample of `first_lights` at the first vertex
    and `deep_lights` at later ones: worse for images of single lights, better for their sum. A
    contribution below `thrift` times its standard deviation over paths (from a pilot pass) casts
    its shadow ray by roulette; 0 casts all. 3 halves the time or better for 5 to 10 % more variance
    on hair; 2 to 8 are within a tenth of it.

    `memory` bounds the bytes of the tiles of pixels, without the returned images.
    """

    spp: Count = 32
    max_depth: Count | None = None
    first_lights: Count | None = None
    deep_lights: Count | None = None
    thrift: Annotated[float, Field(ge=0)] = 3.0
    memory: Count = 1 << 30


def render_olat(
    scene: HairScene,
    camera: Camera,
    lights: Sequence[Lighting],
    *,
    seed: int = 0,
    pixels: ArrayLike | None = None,
    **options: Any,
) -> Floats:
    """Radiance under each of `lights` alone, W/(sr m²) at full level; a pattern's is a sum.

    Returns `(L, P, 3)` for `pixels (P,)` (flat indices), or `(L, H, W, 3)` without `pixels`.
    `options`: see `OlatOptions`. Same arguments, same bytes, with any number of threads. Raises
    `ValueError` for options out of range, `FloatingPointError` for infinite light.
    """
    index = covered_pixels(scene, camera) if pixels is None else pixel_indices(camera, pixels)
    single, mix = components(lights)
    out = _rendered(_View(scene, camera, single, index), OlatOptions(**options), seed, _Light())
    field = field_of(scene, camera, index)
    if field is not None:
        out = field.lit(out, single)
    out = mixed(mix, out)
    return out if pixels is not None else spread_out(out, index, camera)


def render_indirect(
    scene: HairScene,
    camera: Camera,
    lights: Sequence[Lighting],
    pixels: ArrayLike,
    *,
    seed: int = 0,
    **options: Any,
) -> Floats:
    """Indirect light of `render_olat`, `(L, P, 3)`, without the scene's field.

    Fibres scatter the mean of the BSDF over parts of their width (`mean_over_width`).
    """
    single, mix = components(lights)
    view = _View(scene, camera, single, pixel_indices(camera, pixels))
    part = _Light(direct=False, mean_width=True)
    return mixed(mix, _rendered(view, OlatOptions(**options), seed, part))


def render_direct(
    scene: HairScene,
    camera: Camera,
    lights: Sequence[Light],
    pixels: ArrayLike,
    *,
    seed: int = 0,
    **options: Any,
) -> Floats:
    """Direct light of `render_olat`, `(L, P, 3)`, without the scene's field.

    With the mean BSDF of `render_indirect`: half of the paths for the same noise, and 0.6 % too
    bright on the demo's hair (see `mean_over_width`).
    """
    single, mix = components(lights)
    view = _View(scene, camera, single, pixel_indices(camera, pixels))
    part = _Light(mean_width=True)
    return mixed(mix, _rendered(view, OlatOptions(max_depth=1, **options), seed, part))


def spread_out(radiance: Floats, index: Ints, camera: Camera) -> Floats:
    """Images `(L, H, W, 3)` of `radiance (L, P, 3)` at the flat `index (P,)`, 0 elsewhere."""
    out = np.zeros((len(radiance), camera.height * camera.width, 3), np.float32)
    out[:, index] = radiance
    return out.reshape(-1, camera.height, camera.width, 3)


class _Light(NamedTuple):
    """The light that is rendered: with that of first vertices, and with which BSDF."""

    direct: bool = True
    mean_width: bool = False


class _View(NamedTuple):
    """The flat `pixels (P,)` of a camera under each of the lights."""

    scene: HairScene
    camera: Camera
    lights: Sequence[Light]
    pixels: Ints


def _rendered(view: _View, options: OlatOptions, seed: int, light: _Light) -> Floats:
    """`(L, P, 3)` of `light`."""
    index, count, camera = view.pixels, len(view.lights), view.camera
    out = np.zeros((count, len(index), 3), np.float32)
    if out.size:
        plan = _plan(view, options, seed, light)
        # each tile is spread over the whole image
        tiles = tile_count(index, FILM_BYTES * count, options.memory)
        for k in range(tiles):
            part = slice(k, None, tiles)
            out[:, part] = plan.render(index[part], options.spp, (seed, k))

        def again(bad: Ints) -> None:
            out[:, bad] = plan.render(index[bad], options.spp, (seed, tiles))

        def finite() -> Bools:
            return np.asarray(np.isfinite(out).all(axis=(0, 2)))

        render_again(camera, index, finite, again, seed)
    return out


@dataclass(frozen=True)
class _Plan:
    """The input of a rendering, and its sampling.

    `counts`: lights sampled at the first and at later vertices. `dim (L,)`: contributions below
    this radiance cast their shadow ray with a probability in proportion.
    """

    scene: HairScene
    camera: Camera
    lights: Sequence[Light]
    counts: tuple[int, int]
    limits: PathLimits
    dim: Floats
    light: _Light

    def render(self, index: Ints, spp: int, seed: tuple[int, int]) -> Floats:
        """Mean over `spp` paths a pixel: `(L, P, 3)`."""
        count, slots = len(self.lights), opaque_index(len(index))
        film = dr.zeros(mi.Float, 3 * count * len(index))
        surface = Surface(self.scene, mean_width=self.light.mean_width)
        bank, dim = PackedLights.of(self.lights), mi.Float(self.dim)
        gather = _Gather(surface, film, slots, bank, dim, self.counts, self.light.direct)
        follow(surface, self.camera, index, PathPlan(spp, seed, self.limits), gather)
        image = np.array(film).reshape(count, 3, len(index)).transpose(0, 2, 1)
        return np.asarray(image / np.float32(spp), dtype=np.float32)

    def spread(self, index: Ints, spp: int, seed: int) -> Floats:
        """Standard deviation `(L,)` of a path's contribution from each light.

        From a few paths, without the brightest of them, which would dominate.
        """
        wanted = int(np.clip(len(index) * spp // _PILOT_SHARE, 64, _PILOT))
        few = index[:: -(-len(index) // wanted)]

        def pilot(plan: _Plan, pixels: Ints, number: int) -> Floats:
            brightest = plan.render(pixels, 1, (seed, _PILOT_STREAM + number)).max(-1)
            return np.minimum(brightest, np.quantile(brightest, _USUAL, axis=1, keepdims=True))

        # the mean of fewer still, with every shadow ray, is enough to spare most in the rest
        sparing = replace(self, dim=pilot(self, few[::8], 0).mean(1))
        one, other = np.split(pilot(sparing, np.concatenate([few, few]), 1), 2, axis=1)
        # squares of bright light overflow in float32, of dim light they vanish
        squares = (one.astype(float) - other) ** 2
        return np.asarray(np.sqrt(squares.mean(1) / 2), np.float32)


def _plan(view: _View, options: OlatOptions, seed: int, light: _Light) -> _Plan:
    scene, camera, lights, index = view
    wanted = (options.first_lights, options.deep_lights)
    first, deep = (len(lights) if n is None else min(n, len(lights)) for n in wanted)
    depth = options.max_depth or bounce_limit(scene, camera, pixels=index, seed=seed).depth
    none = np.zeros(len(lights), np.float32)
    plan = _Plan(scene, camera, lights, (first, deep), PathLimits(depth), none, light)
    if options.thrift > 0:
        spread = plan.spread(index, options.spp, seed)
        plan = replace(plan, dim=np.float32(options.thrift) * spread)
    return plan


@dataclass(frozen=True)
class _Gather:
    """Light from the bank, or a systematic sample of it, at a path's vertex.

    Unless `direct`, first vertices gather none.
    """

    surface: Surface
    film: Any
    slots: Any
    bank: PackedLights
    dim: Any
    counts: tuple[int, int]
    direct: bool

    def __call__(self, si: Any, paths: Paths) -> None:
        total, active, slot = opaque_index(self.bank.count), paths.active, paths.slot
        if not self.direct:
            active = active & (paths.depth > 0)
        count = dr.select(paths.depth == 0, *(opaque_index(n) for n in self.counts))
        stride = mi.Float(total) / mi.Float(count)
        sampled = min(self.counts) < self.bank.count
        start = paths.rng.next_float32() * stride if sampled else mi.Float(0)
        extended = self.bank.radii is not None or self.bank.sizes is not None
        word = mi.UInt64(paths.rng.next_uint32()) if extended else mi.UInt64(0)
        throughput, towards = paths.throughput * stride, self.surface.towards(si, active)

        def scattered(wo: Any, active: Any) -> Any:
            return throughput * towards(wo, active)

        def source(j: Any, active: Any) -> tuple[Any, PointSource]:
            light = j
            if sampled:
                light = dr.minimum(mi.UInt32(mi.Float(j) * stride + start), total - 1)
            rng = stream_of(word, mi.UInt64(light))  # the same point of the light each time
            target, intensity = self.bank.sample(light, si.p, rng, active)
            return light, PointSource(
                target, intensity, dr.gather(mi.Float, self.dim, light, active)
            )

        def block(first: Any, rng: Any) -> Any:
            def choose(j: Any, cast: Any, rng: Any) -> Any:
                _, light = source(first + j, active)
                _, lit = unshadowed(si, scattered, light, rng.next_float32(), active)
                return j + 1, cast | dr.select(lit, mi.UInt32(1) << j, 0), rng

            end = dr.minimum(count - first, _BLOCK)
            _, cast, rng = dr.while_loop(
                (mi.UInt32(0), mi.UInt32(0), rng),
                lambda j, cast, rng: active & (j < end),
                choose,
                label="lights that cast a shadow ray",
            )

            def shine(cast: Any) -> Any:
                lit = cast != 0
                number, light = source(first + dr.tzcnt(cast), lit)
                value, lit = light_from(self.surface.scene, si, scattered, light, mi.Float(0), lit)
                add_light(self.film, value, number * 3 * self.slots + slot, lit, self.slots)
                return (cast & (cast - 1),)

            dr.while_loop((cast,), lambda cast: cast != 0, shine, label="shadow rays")
            return first + _BLOCK, rng

        dr.while_loop(
            (mi.UInt32(0), paths.rng),
            lambda first, rng: active & (first < count),
            block,
            label="lights of a vertex",
        )

"""Cached camera paths, evaluated again for other hair without tracing a ray.

An image is a mean over paths of products of BSDF values over sampling densities. Cached are each
vertex's place on its strand and its directions in the fibre's frame, and the direction and radiance
of each light that reached it. For one set of paths the image is a smooth function of the hair with
exact derivatives; its noise grows with the distance to the hair that the paths were sampled with.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any

import drjit as dr
import mitsuba as mi
import numpy as np
from pydantic import Field

from appearance.bsdf.parameters import StrandHit
from appearance.render.lights import PackedLights
from appearance.render.paths import Surface, jittered, stream
from appearance.scene.hair_scene import HairScene
from appearance.scene.opaque import opaque, opaque_index
from reconstruction import Camera, Light
from reconstruction.array_backend import for_kernels, rows_of
from reconstruction.arrays import Array, Bools, Floats, Ints
from reconstruction.geometry.lights import Lighting, components, mixed
from reconstruction.options import Count, options

_ROULETTE = 0.3
"""Throughput below which a path survives with probability in proportion."""
_ROOM = 6
"""Lights per vertex for which buffers are allocated at first."""
_STREAM, _LIGHT_STREAM = 100, 200
_TINY = 1e-20


@options
class CachedSampling:
    """`spp` paths a pixel of at most `max_depth` vertices.

    A light with a contribution below `dim`, in units of the pixels' importance, casts its shadow
    ray with probability in proportion (Russian roulette).
    """

    spp: Count = 8
    max_depth: Count = 8
    dim: Annotated[float, Field(gt=0)] = 0.3


@dataclass(frozen=True, eq=False)
class WeightedPixels:
    """Flat pixel indices `index (P,)` and their weights in each picture, `importance (M, P)`."""

    index: Ints
    importance: Floats


@dataclass(frozen=True, eq=False)
class Scattering:
    """N times that light is scattered at a vertex: towards a light, or along the path.

    `vertex (N,)` is the vertex's number, `direction (N, 3)` where the light comes from, in the
    fibre's uncorrected frame, `scale (N,)` what the BSDF times cosine is multiplied by, and
    `value (N, 3)` that BSDF times cosine of the hair that the paths were drawn with.
    """

    vertex: Ints
    direction: Floats
    scale: Floats
    value: Floats


@dataclass(frozen=True, eq=False)
class CachedPaths:
    """The paths of one camera through P pixels under L lights, `spp` a pixel.

    V vertices in order of depth, those of one depth in order of their paths: `path (V,)` numbers
    the paths, of which path p goes through pixel p mod P. `hair (V,)` marks fibres, not skin. Of
    fibres, `strand (V,)` and `along (V,)`, 0 at the root and 1 at the tip, say where they are met,
    `incoming (V, 3)` is the direction towards the camera, `normal (V, 2)` the strand's first normal
    across the fibre, both in the fibre's uncorrected frame. `onward` has one row for each vertex
    but the first of a path, in their order: how the vertex before it scattered. `lit` are lights
    that reach vertices, `light (len(lit),)` which. `starts` are the numbers of the first vertex of
    each depth, and V. `mix (M, L)` turns pictures under the lights into those under patterns of
    them, see `components`.
    """

    pixels: int
    lights: int
    spp: int
    path: Ints
    hair: Bools
    strand: Ints
    along: Floats
    incoming: Floats
    normal: Floats
    onward: Scattering
    lit: Scattering
    light: Ints
    starts: Ints
    mix: Array | None = None

    @property
    def nbytes(self) -> int:
        """Bytes that the paths take."""
        parts = [getattr(x, f.name) for x in (self, self.onward, self.lit) for f in fields(x)]
        return sum(x.nbytes for x in parts if isinstance(x, np.ndarray))


def cache_paths(
    scene: HairScene,
    camera: Camera,
    lights: Sequence[Lighting],
    pixels: WeightedPixels,
    sampling: CachedSampling,
    seed: int,
) -> CachedPaths:
    """Draw paths with the hair of `scene`, which has maps on its strands (`with_maps`).

    Same arguments, same bytes.
    """
    single, mix = components(lights)
    if mix is not None:
        pixels = replace(pixels, importance=mixed(mix.T, pixels.importance))
    return replace(_Drawing(Surface(scene), single, pixels, sampling, seed).run(camera), mix=mix)


@dataclass(frozen=True)
class _Vertices:
    """The lanes of one depth, all Dr.Jit variables; lanes that are not `valid` met nothing.

    `number` is the NumPy array of their vertices' numbers.
    """

    si: Any
    valid: Any
    frame: Any
    throughput: Any
    path: Any
    number: Ints


@dataclass(frozen=True)
class _Drawing:
    surface: Surface
    lights: Sequence[Light]
    pixels: WeightedPixels
    sampling: CachedSampling
    seed: int

    def run(self, camera: Camera) -> CachedPaths:
        count, spp = len(self.pixels.index), self.sampling.spp
        bsdf: Any = self.surface.scene.hair_bsdf
        path = dr.arange(mi.UInt32, count * spp)
        slots = opaque_index(count)
        sample = path // slots
        pixel = mi.UInt32(for_kernels(self.pixels.index, np.uint32))
        pixel = dr.gather(mi.UInt32, pixel, path - sample * slots)
        ray = jittered(camera, pixel, sample, spp, stream(count * spp, self.seed, _STREAM - 1))
        throughput = dr.ones(mi.Color3f, count * spp)
        vertices: list[list[Any]] = []
        onward: list[list[Any]] = []
        lit: list[list[Any]] = []
        starts = [0]
        links: list[Any] | None = None
        for depth in range(self.sampling.max_depth):
            dr.eval(ray, throughput, path)
            si = self.surface.interact(ray, mi.Bool(True))
            valid = si.is_valid()
            hair = valid & self.surface.is_hair(si)
            parameters = bsdf.parameters
            place = StrandHit(parameters.strands, si, hair)
            frame = parameters.straight(place)
            normal = frame.enter(si.to_local(place.normal))
            along = dr.select(hair, place.along, 0)
            met = [path, hair, place.strand, along, frame.enter(si.wi)]
            met.append(mi.Vector2f(normal.x, normal.z))

            rng = stream(dr.width(path), self.seed, _STREAM + depth)
            u1, u2 = rng.next_float32(), mi.Point2f(rng.next_float32(), rng.next_float32())
            wo, weight = self.surface.sample(si, u1, u2, valid)
            value = self.surface.eval(si, wo, valid)
            after = throughput * weight
            strength = dr.max(after)
            survival = dr.minimum(1, strength * (1 / _ROULETTE))
            alive = valid & (strength > 0) & (rng.next_float32() < survival)
            # the weight is the value over the density
            scale = dr.max(weight) / (dr.maximum(dr.max(value), _TINY) * survival)
            step = [frame.enter(wo), scale, value]
            following, after = si.spawn_ray(si.to_world(wo)), after / survival
            dr.eval(met, step, following, after, alive, valid, si)

            keep = np.flatnonzero(np.array(valid))
            number = np.full(dr.width(path), -1, np.int64)
            number[keep] = starts[-1] + np.arange(len(keep))
            if links is not None:
                onward.append([x[keep] for x in links])
            vertices.append([rows_of(x)[keep] for x in met])
            lit.append(self._lit(_Vertices(si, valid, frame, throughput, path, number), depth))
            starts.append(starts[-1] + len(keep))
            going: Any = dr.compress(alive)  # untyped
            if depth + 1 == self.sampling.max_depth or dr.width(going) == 0:
                break
            at = np.array(going)
            links = [number[at], *(rows_of(x)[at] for x in step)]
            ray = dr.gather(mi.Ray3f, following, going)
            throughput = dr.gather(mi.Color3f, after, going)
            path = dr.gather(mi.UInt32, path, going)
        joined = _joined(lit)
        path, hair, strand, along, incoming, normal = _joined(vertices)
        return CachedPaths(
            count,
            len(self.lights),
            spp,
            path,
            hair,
            strand,
            along,
            incoming,
            normal,
            Scattering(*(_joined(onward) if onward else _nothing())),
            Scattering(*joined[:4]),
            joined[4],
            np.array(starts),
        )

    def _lit(self, v: _Vertices, depth: int) -> list[Any]:
        """Rows of `Scattering`, and the light's number, where lights reach the vertices."""
        lanes = len(v.number)
        room = max(1024, lanes * _ROOM)
        found = _Found.empty(room)
        self._cast(v, stream(lanes, self.seed, _LIGHT_STREAM + depth), found)
        if found.count > room:
            found = _Found.empty(found.count)
            self._cast(v, stream(lanes, self.seed, _LIGHT_STREAM + depth), found)
        which = np.array(found.ints).reshape(-1, 2)[: found.count]
        rows = np.array(found.floats).reshape(-1, 7)[: found.count]
        # lanes came in no fixed order
        order = np.argsort(which[:, 0].astype(np.int64) * len(self.lights) + which[:, 1])
        which, rows = which[order], rows[order]
        return [v.number[which[:, 0]], rows[:, :3], rows[:, 3], rows[:, 4:], which[:, 1]]

    def _cast(self, v: _Vertices, rng: Any, found: _Found) -> None:
        """Cast shadow rays to the lights, and put what arrives where there is room."""
        bank = PackedLights.of(self.lights)
        importance = mi.Float(for_kernels(self.pixels.importance.ravel()))
        total, slots = opaque_index(len(self.lights)), opaque_index(len(self.pixels.index))
        (dim,) = opaque(self.sampling.dim)
        slot, lane = v.path % slots, dr.arange(mi.UInt32, len(v.number))
        scattered = self.surface.towards(v.si, v.valid)

        def more(light: Any, rng: Any) -> Any:
            return v.valid & (light < total)

        def body(light: Any, rng: Any) -> Any:
            target, intensity = bank.sample(light, v.si.p, rng, v.valid)
            towards = target - v.si.p
            squared = dr.squared_norm(towards)
            wo = v.si.to_local(towards * dr.rsqrt(squared))
            value = scattered(wo, v.valid)
            counts = dr.gather(mi.Float, importance, light * slots + slot, v.valid)
            bright = dr.max(v.throughput * value * intensity) * counts / squared
            chance = dr.minimum(1, bright / dim)
            lit = v.valid & (rng.next_float32() < chance)
            lit &= ~self.surface.scene.occluded(v.si.spawn_ray_to(target), lit)
            full = dr.sum(dr.gather(mi.Color3f, bank.intensities, light, v.valid))
            scale = dr.sum(intensity) / (full * squared * chance)
            found.put((lane, light), (*v.frame.enter(wo), scale, *value), lit)
            return light + 1, rng

        state = (dr.zeros(mi.UInt32, len(v.number)), rng)
        dr.while_loop(state, more, body, label="lights of a vertex")
        dr.eval(found.taken, found.ints, found.floats)


@dataclass(frozen=True)
class _Found:
    """Rows of 2 integers and 7 floats, in no fixed order; `taken` counts those there was no room
    for, too."""

    room: Any
    taken: Any
    ints: Any
    floats: Any

    @classmethod
    def empty(cls, room: int) -> _Found:
        return cls(
            opaque_index(room),
            dr.zeros(mi.UInt32, 1),
            dr.zeros(mi.UInt32, 2 * room),
            dr.zeros(mi.Float, 7 * room),
        )

    @property
    def count(self) -> int:
        return int(self.taken[0])

    def put(self, ints: Sequence[Any], floats: Sequence[Any], active: Any) -> None:
        row: Any = dr.scatter_inc(self.taken, mi.UInt32(0), active)
        active = active & (row < self.room)
        for i, value in enumerate(ints):
            dr.scatter(self.ints, value, 2 * row + i, active)
        for i, value in enumerate(floats):
            dr.scatter(self.floats, value, 7 * row + i, active)


def _joined(parts: Sequence[Sequence[Any]]) -> list[Any]:
    return [np.concatenate(x) for x in zip(*parts, strict=True)]


def _nothing() -> list[Any]:
    return [np.zeros(0, np.int64), *(np.zeros((0, *n), np.float32) for n in ((3,), (), (3,)))]

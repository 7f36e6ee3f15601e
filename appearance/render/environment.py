"""Images under an environment map: lat-long radiance around the subject.

Blender's equirectangular convention: row 0 of a map `(h, w, 3)` is the zenith (+z), the last row
the nadir; the middle column is +x, and columns to its right turn clockwise from above (towards −y).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance.render.coverage import covered_pixels
from appearance.render.environment_maps import check_environment
from appearance.render.harmonics import projected
from appearance.render.paths import (
    Surface,
    Wave,
    camera_rays,
    each_sample,
    seed_state,
    stream_of,
)
from appearance.render.pixel_field import DeviceField, PixelField, factor_of, field_of
from appearance.render.tracing import (
    SAMPLING,
    PathPlan,
    Paths,
    Sampling,
    add_light,
    follow,
    render_whole,
)
from appearance.scene.hair_scene import HairScene
from appearance.scene.opaque import opaque, opaque_index
from reconstruction import Camera
from reconstruction.array_backend import for_kernels, rows_of
from reconstruction.arrays import AnyFloats, Floats, Ints

CANDIDATES, DEEP = 8, 4
"""Directions that one of a vertex's is chosen from; where only indirect light is."""
PER_HIT = 2
"""Directions of direct light at a first hit: shadows have more of the noise than hits."""
_GOLDEN = 0x9E3779B9
"""The golden ratio's fraction times 2³²."""


def render_environment(
    scene: HairScene,
    camera: Camera,
    envmap: AnyFloats,
    sampling: Sampling = SAMPLING,
    *,
    rotation_deg: float = 0.0,
    background: bool = False,
) -> Floats:
    """Radiance `(H, W, 3)`, W/(sr m²), of the subject lit by `envmap (h, w, 3)` alone.

    `rotation_deg` turns the map counter-clockwise from above. Pixels off the subject are 0, or the
    map with `background`. Each vertex samples one direction (`Sky.resampled`).
    Raises `ValueError` for negative or infinite maps, `FloatingPointError` for infinite light.
    """
    sky = Sky.of(check_environment(envmap, "envmap"), rotation_deg)
    image = np.zeros((camera.height * camera.width, 3), np.float32)
    if background:
        row, column = np.divmod(np.arange(len(image)), camera.width)
        rays = camera_rays(camera, mi.Float(column + 0.5), mi.Float(row + 0.5))
        image[:] = rows_of(sky.radiance(rays.d))
    index = covered_pixels(scene, camera)

    def render(some: Ints, plan: PathPlan) -> None:
        film = dr.zeros(mi.Float, 3 * len(some))
        field = field_of(scene, camera, some)
        gather = _Gather(Surface(scene), film, sky, factor_of(field))

        def missed(ray: Any, paths: Paths) -> None:
            add_light(film, sky.radiance(ray.d), paths.slot * 3, paths.active & (paths.depth == 0))

        follow(gather.surface, camera, some, plan, gather, missed if background else None)
        image[some] = np.array(film).reshape(len(some), 3) / np.float32(plan.spp)
        image[some] = _with_added(image[some], field, envmap, rotation_deg)

    render_whole(camera, index, image, render, sampling.plan())
    return image.reshape(camera.height, camera.width, 3)


def direct_environment(
    scene: HairScene,
    camera: Camera,
    envmap: AnyFloats,
    spp: int,
    seed: int = 0,
    *,
    pixels: Ints | None = None,
) -> Floats:
    """`render_environment` to the first hit alone `(H, W, 3)`, its directions well spread.

    Of flat `pixels (P,)`, or of all that see the subject, with `PER_HIT` directions a hit. A
    pixel's directions are a golden-ratio sequence on a curve through the map (`_along_curve`):
    under half the noise of independent ones on smooth surfaces. Fibres scatter the mean over parts
    of their width.
    """
    sky = Sky.of(check_environment(envmap, "envmap"), 0.0)
    image = np.zeros((camera.height * camera.width, 3), np.float32)
    index = covered_pixels(scene, camera) if pixels is None else pixels
    if len(index):
        film = dr.zeros(mi.Float, 3 * len(index))
        field, surface = field_of(scene, camera, index), Surface(scene, mean_width=True)
        gather, origin = _Gather(surface, film, sky, factor_of(field)), seed_state(seed, 1)

        def trace(wave: Wave) -> None:
            si = surface.interact(wave.rays, mi.Bool(True))
            place = stream_of(origin, mi.UInt64(wave.slot)).next_uint32()
            hit = Paths(mi.Color3f(1), mi.UInt32(0), wave.slot, wave.rng, si.is_valid())
            for k in range(PER_HIT):
                gather.add(si, hit, place + (wave.sample * PER_HIT + k) * CANDIDATES * _GOLDEN)

        each_sample(camera, mi.UInt32(for_kernels(index, np.uint32)), len(index), spp, seed, trace)
        image[index] = np.array(film).reshape(len(index), 3) / np.float32(spp * PER_HIT)
        image[index] = _with_added(image[index], field, envmap, 0.0)
    return image.reshape(camera.height, camera.width, 3)


def indirect_environment(
    scene: HairScene, camera: Camera, envmap: AnyFloats, sampling: Sampling, pixels: Ints
) -> Floats:
    """`render_environment` from the second hit on, of flat `pixels (P,)`: `(H, W, 3)`.

    Fibres scatter the mean over parts of their width. A field that is all of the light has none.
    """
    sky = Sky.of(check_environment(envmap, "envmap"), 0.0)
    image = np.zeros((camera.height * camera.width, 3), np.float32)

    def render(some: Ints, plan: PathPlan) -> None:
        film, field = dr.zeros(mi.Float, 3 * len(some)), field_of(scene, camera, some)
        if field is not None and field.additive and field.alone:
            return
        gather = _Gather(Surface(scene, mean_width=True), film, sky, factor_of(field), DEEP)

        def vertex(si: Any, paths: Paths) -> None:
            gather(si, replace(paths, active=paths.active & (paths.depth > 0)))

        follow(gather.surface, camera, some, plan, vertex)
        image[some] = np.array(film).reshape(len(some), 3) / np.float32(plan.spp)

    render_whole(camera, pixels, image, render, sampling.plan())
    return image.reshape(camera.height, camera.width, 3)


def _with_added(
    radiance: Floats, field: PixelField | None, envmap: AnyFloats, rotation_deg: float
) -> Floats:
    """`radiance (P, 3)` and what an additive field adds to it."""
    if field is None or not field.additive:
        return radiance
    integrals = projected(envmap, rotation_deg, field.degree)
    added = field.added((), np.zeros((0, 3)), [integrals])
    return np.maximum(added if field.alone else radiance + added, 0)


def _along_curve(height: int, width: int) -> Ints:
    """Flat indices of all texels of `(height, width)` along Hilbert's curve `(height · width,)`.

    Neighbours on the curve are neighbours in the map. The curve is that of the least square of a
    power of two that holds the map.
    """
    row, column = np.indices((height, width)).reshape(2, -1)
    place = np.zeros(len(row), np.int64)
    y, x, size = row.copy(), column.copy(), 1 << (max(height, width) - 1).bit_length()
    step = size // 2
    while step:
        right, below = (x & step) > 0, (y & step) > 0
        place += step * step * ((3 * right) ^ below)
        turn, flip = ~below, ~below & right
        x, y = np.where(flip, size - 1 - x, x), np.where(flip, size - 1 - y, y)
        x, y = np.where(turn, y, x), np.where(turn, x, y)
        step //= 2
    return np.argsort(place)


@dataclass(frozen=True)
class Sky:
    """A map on the device, constant over each texel.

    `distribution` is that of the texels along a curve, on which texel number k of the map is the
    `order[k]`-th.
    """

    texels: Any
    order: Any
    distribution: Any
    width: Any
    height: Any
    turn: Any

    @classmethod
    def of(cls, envmap: Floats, rotation_deg: float) -> Sky:
        """The sky of `envmap (h, w, 3)`, turned counter-clockwise from above.

        Raises `ValueError` for a turn that is not finite.
        """
        if not np.isfinite(rotation_deg):
            raise ValueError(f"an environment's rotation_deg must be finite, got {rotation_deg}")
        height, width = envmap.shape[:2]
        edges = np.cos(np.linspace(0, np.pi, height + 1))
        weight = envmap.astype(float).sum(-1) * (edges[:-1] - edges[1:])[:, None]
        weight = np.maximum(weight, 1e-6 * weight.max(initial=0.0))
        if weight.max(initial=0.0) == 0:
            weight = np.ones_like(weight)
        (turn,) = opaque(rotation_deg / 360 % 1)
        order = _along_curve(height, width)
        chance = (weight / weight.sum()).ravel()[order]
        return cls(
            mi.Float(for_kernels(np.ravel(envmap))),
            mi.UInt32(for_kernels(order, np.uint32)),
            mi.DiscreteDistribution(mi.Float(for_kernels(chance))),
            opaque_index(width),
            opaque_index(height),
            turn,
        )

    def radiance(self, direction: Any) -> Any:
        """`Color3f` that arrives from `direction`."""
        u = 0.5 + self.turn - dr.atan2(direction.y, direction.x) * dr.inv_two_pi
        u = u - dr.floor(u)
        v = dr.safe_acos(direction.z) * dr.inv_pi
        column = dr.minimum(mi.UInt32(u * mi.Float(self.width)), self.width - 1)
        row = dr.minimum(mi.UInt32(v * mi.Float(self.height)), self.height - 1)
        return dr.gather(mi.Color3f, self.texels, row * self.width + column)

    def sample(self, rng: Any, active: Any, place: Any = None) -> tuple[Any, Any]:
        """A direction, and its radiance divided by the density of the draw.

        `place` in [0, 1) is that on the curve; random where None.
        """
        place = rng.next_float32() if place is None else place
        number, chance = self.distribution.sample_pmf(place, active)
        texel = dr.gather(mi.UInt32, self.order, number, active)
        row = texel // self.width
        u = (mi.Float(texel - row * self.width) + rng.next_float32()) / mi.Float(self.width)
        # Uniform in solid angle over the texel: its rows bound z, not the angle.
        top = dr.cos(dr.pi * mi.Float(row) / mi.Float(self.height))
        bottom = dr.cos(dr.pi * mi.Float(row + 1) / mi.Float(self.height))
        z = dr.lerp(top, bottom, rng.next_float32())
        sin, cos = dr.sincos((0.5 + self.turn - u) * dr.two_pi)
        radius = dr.safe_sqrt(1 - z * z)
        solid_angle = (top - bottom) * dr.two_pi / mi.Float(self.width)
        value = dr.gather(mi.Color3f, self.texels, texel, active) * (solid_angle / chance)
        return mi.Vector3f(radius * cos, radius * sin, z), value

    def resampled(
        self,
        si: Any,
        scattered: Callable[[Any, Any], Any],
        rng: Any,
        active: Any,
        count: int,
        place: Any = None,
    ) -> tuple[Any, Any]:
        """A direction, and its light scattered at `si` divided by the density of the draw.

        `scattered` is `Surface.towards` of `si`. Of `count` draws of `sample` one is kept, in
        proportion to its scattered light: resampled importance sampling (Talbot et al. 2005). The
        draws are at golden-ratio steps from `place` / 2³² on the curve; random where None.
        """

        def more(k: Any, *_: Any) -> Any:
            return active & (k < draws)

        def body(k: Any, kept: Any, colour: Any, total: Any, rng: Any) -> Any:
            at = None if place is None else mi.Float(place + k * _GOLDEN >> 8) * 2**-24
            direction, light = self.sample(rng, active, at)
            value = scattered(si.to_local(direction), active) * light
            size = dr.mean(value)
            total = total + size
            taken = rng.next_float32() * total < size
            kept = dr.select(taken, direction, kept)
            colour = dr.select(taken, value / size, colour)
            return k + 1, kept, colour, total, rng

        width, draws = dr.width(active), opaque_index(count)
        start = (dr.zeros(mi.UInt32, width), mi.Vector3f(0, 0, 1), mi.Color3f(0), mi.Float(0), rng)
        end: Any = dr.while_loop(start, more, body, label="candidates")
        _, kept, colour, total, after = end
        rng.state = after.state
        return kept, colour * (total / mi.Float(draws))


@dataclass(frozen=True)
class _Gather:
    """Light from one direction of the sky at a path's vertex."""

    surface: Surface
    film: Any
    sky: Sky
    factor: DeviceField | None
    count: int = CANDIDATES

    def __call__(self, si: Any, paths: Paths) -> None:
        self.add(si, paths)

    def add(self, si: Any, paths: Paths, place: Any = None) -> None:
        """Add the light from one direction; see `Sky.resampled` for `place`."""
        active, scattered = paths.active, self.surface.towards(si, paths.active)
        towards, value = self.sky.resampled(si, scattered, paths.rng, active, self.count, place)
        value = value * paths.throughput
        if self.factor is not None:
            value = value * self.factor.towards(paths.slot, towards, active)
        lit = active & (dr.max(value) > 0)
        lit &= ~self.surface.scene.occluded(si.spawn_ray(towards), lit)
        add_light(self.film, value, paths.slot * 3, lit)

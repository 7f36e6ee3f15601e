"""Shared by all renderers: camera rays, surfaces and their BSDF, random streams."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from appearance.scene.hair_scene import SCALE, SHINE_EXPONENT, HairScene
from appearance.scene.opaque import opaque, opaque_index, opaque_matrix
from reconstruction import Camera
from reconstruction.array_backend import for_kernels
from reconstruction.arrays import Ints
from reconstruction.geometry.cameras import undistorted

_SQUARE = 1e-3
"""Cosine between two axes of a shading frame from which on it is no frame."""


def camera_rays(camera: Camera, u: Any, v: Any) -> Any:
    """Mitsuba rays through the image points `u`, `v` (Dr.Jit floats), in scene units.

    The top-left pixel covers [0, 1) x [0, 1) here; in `Camera`'s convention its centre is (0, 0).
    """
    k = opaque([camera.K[0, 0], camera.K[0, 1], camera.K[0, 2], camera.K[1, 1], camera.K[1, 2]])
    y = (v - 0.5 - k[4]) / k[3]
    x = (u - 0.5 - k[2] - k[1] * y) / k[0]
    if camera.distorted:
        x, y = undistorted(opaque(camera.distortion), x, y)
    direction = opaque_matrix(camera.R.T) @ mi.Vector3f(x, y, mi.Float(1))
    return mi.Ray3f(mi.Point3f(*opaque(camera.center * SCALE)), dr.normalize(direction))


@dataclass(frozen=True)
class Surface:
    """The surfaces of `scene` and their BSDF; made once a kernel.

    With `mean_width` a fibre scatters the mean over parts of its width (`mean_over_width`).
    """

    scene: HairScene
    mean_width: bool = field(default=False, kw_only=True)

    def interact(self, ray: Any, active: Any) -> Any:
        """The first `SurfaceInteraction3f` along `ray`.

        Around a fibre exactly along z Mitsuba's `dp_du` may be parallel to the normal; the shading
        frame is then made of `dp_dv`.
        """
        si = self.scene.mi_scene.ray_intersect(ray, active)
        if self.scene.hair_shape is None:
            return si
        frame = si.sh_frame
        broken = self.is_hair(si) & (dr.abs(dr.dot(frame.n, frame.s)) > _SQUARE)
        across = dr.normalize(dr.cross(si.dp_dv, frame.n))
        frame.s = dr.select(broken, across, frame.s)
        frame.t = dr.select(broken, dr.cross(frame.n, across), frame.t)
        si.sh_frame = frame
        si.wi = dr.select(broken, si.to_local(-ray.d), si.wi)
        return si

    def is_hair(self, si: Any) -> Any:
        """Whether `si` lies on a fibre."""
        if self.scene.hair_shape is None:
            return mi.Bool(False)
        if self.scene.head_shape is None:
            return si.is_valid()
        return si.shape == mi.ShapePtr(self.scene.hair_shape)

    def eval(self, si: Any, wo: Any, active: Any) -> Any:
        """BSDF times cosine `Color3f` towards the local direction `wo`."""
        return self.towards(si, active)(wo, active)

    def towards(self, si: Any, active: Any) -> Callable[[Any, Any], Any]:
        """`eval` of `si` as a function of `(wo, active)`, for many directions."""
        hair = self.is_hair(si)
        albedo, bsdf = self._diffuse(si, hair) * dr.inv_pi, self.scene.hair_bsdf
        shine = self._shine(si, hair)
        fibre = None
        if bsdf is not None and hasattr(bsdf, "towards"):
            fibre = bsdf.towards(si, active & hair, self.mean_width)
        elif bsdf is not None:
            fibre = partial(bsdf.eval, mi.BSDFContext(), si)

        def value(wo: Any, active: Any) -> Any:
            reflected = albedo if shine is None else albedo + shine(wo)
            diffuse = reflected * self._cosine(si, wo, hair)
            if fibre is None:
                return dr.select(active, diffuse, 0)
            return dr.select(active, dr.select(hair, fibre(wo, active & hair), diffuse), 0)

        return value

    def sample(self, si: Any, u1: Any, u2: Any, active: Any) -> tuple[Any, Any]:
        """A local direction and its weight (BSDF times cosine over density)."""
        hair = self.is_hair(si)
        wo = mi.warp.square_to_cosine_hemisphere(u2)
        inside = ~hair & (si.wi.z < 0)
        wo.z = dr.select(inside, -wo.z, wo.z)
        diffuse = self._diffuse(si, hair)
        if (shine := self._shine(si, hair)) is not None:
            diffuse += dr.pi * shine(wo)
        weight = dr.select(hair & (si.wi.z < 0), 0, diffuse)
        if self.scene.hair_bsdf is not None:
            sample, value = self.scene.hair_bsdf.sample(mi.BSDFContext(), si, u1, u2, active & hair)
            wo = dr.select(hair, sample.wo, wo)
            weight = dr.select(hair, value, weight)
        return wo, dr.select(active, weight, 0)

    def _diffuse(self, si: Any, hair: Any) -> Any:
        skin = mi.Color3f(*self.scene.skin)
        if self.scene.materials is not None:
            values = mi.Float(for_kernels(self.scene.materials.albedo.ravel()))
            skin = dr.gather(mi.Color3f, values, si.prim_index, ~hair & si.is_valid())
        albedo = getattr(self.scene.hair, "albedo", None)
        return skin if albedo is None else dr.select(hair, mi.Color3f(*albedo), skin)

    def _shine(self, si: Any, hair: Any) -> Callable[[Any], Any] | None:
        """Specular part of the BSDF towards `wo`; None if no face has any."""
        if self.scene.materials is None or not self.scene.materials.shine.any():
            return None
        values = mi.Float(for_kernels(self.scene.materials.shine))
        share = dr.gather(mi.Float, values, si.prim_index, ~hair & si.is_valid())
        share *= (SHINE_EXPONENT + 8) / (8 * dr.pi)

        def towards(wo: Any) -> Any:
            half = dr.normalize(si.wi + wo)
            return share * dr.power(dr.abs(half.z), SHINE_EXPONENT)

        return towards

    def _cosine(self, si: Any, wo: Any, hair: Any) -> Any:
        """|cos| where both directions are on one side; fibres have an outer side only."""
        seen = (si.wi.z * wo.z > 0) & (~hair | (wo.z > 0))
        return dr.select(seen, dr.abs(wo.z), 0)


@dataclass(frozen=True)
class PointSource:
    """A point to cast a shadow ray at, and its intensity.

    A contribution below `dim` casts its shadow ray with probability contribution/`dim` and then
    counts as `dim`.
    """

    position: Any
    intensity: Any
    dim: Any


def light_from(
    scene: HairScene,
    si: Any,
    scattered: Callable[[Any, Any], Any],
    source: PointSource,
    chance: Any,
    active: Any,
) -> tuple[Any, Any]:
    """Radiance `Color3f` that `source` sends along the path, and where it arrives.

    `scattered(wo, active)` is the path's throughput times `Surface.towards` of `si`. `chance` in
    [0, 1) decides about the shadow rays of dim contributions.
    """
    value, lit = unshadowed(si, scattered, source, chance, active)
    return value, lit & ~scene.occluded(si.spawn_ray_to(source.position), lit)


def unshadowed(
    si: Any, scattered: Callable[[Any, Any], Any], source: PointSource, chance: Any, active: Any
) -> tuple[Any, Any]:
    """`light_from` without the shadow ray, and where one is to be cast."""
    towards = source.position - si.p
    squared = dr.squared_norm(towards)
    wo = si.to_local(towards * dr.rsqrt(squared))
    value = scattered(wo, active) * (source.intensity / squared)
    brightest = dr.max(value)
    kept = dr.maximum(brightest, source.dim)
    chance = dr.maximum(chance, 1e-9)  # at 0 a contribution of 1e-40 would count as infinitely many
    return value * (kept / brightest), active & (chance * kept < brightest)


def pixel_indices(camera: Camera, pixels: ArrayLike) -> Ints:
    """`pixels (P,)` as flat indices, row after row; raises `ValueError` outside the image."""
    index = np.asarray(pixels, np.int64)
    if index.ndim != 1 or (len(index) and (index.min() < 0 or index.max() >= _size(camera))):
        raise ValueError(
            f"{camera.name}: pixels must be a list of flat indices in [0, {_size(camera)}), "
            f"got shape {index.shape}"
        )
    return index


def _size(camera: Camera) -> int:
    return camera.width * camera.height


def stream(size: int, *seeds: int) -> Any:
    """Random streams of `size` lanes that depend on all of `seeds`."""
    return stream_of(seed_state(*seeds), dr.arange(mi.UInt64, size))


def stream_of(state: Any, lane: Any) -> Any:
    """The random stream of a `lane`, a `UInt64`; `state` is the result of `seed_state`.

    Each begins at a hash of the two: PCG32 streams with states a fixed step apart correlate by up
    to 0.4.
    """
    low, high = mi.UInt32(lane) ^ mi.UInt32(state), mi.UInt32(lane >> 32) ^ mi.UInt32(state >> 32)
    hashed: Any = mi.sample_tea_64  # nor do the stubs take Dr.Jit's plain integers
    generator: Any = mi.PCG32  # which they call a plain object
    return generator(1, hashed(low, high), lane)


def seed_state(*seeds: int) -> Any:
    """A `UInt64` made of all of `seeds`, which kernels read from memory."""
    state = np.random.SeedSequence([n & 0xFFFFFFFF for n in seeds]).generate_state(1, np.uint64)
    return dr.opaque(mi.UInt64, int(state[0]))


def jittered(camera: Camera, pixel: Any, sample: Any, spp: int, rng: Any) -> Any:
    """Rays of sample number `sample` of `spp` through `pixel`: jittered on a grid over the pixel.

    Samples beyond the largest square grid fall anywhere in the pixel. A box filter, as the sensor
    integrates, or `camera.filter_sigma`'s Gaussian, onto which the grid is stretched.
    """
    n = opaque_index(int(spp**0.5))
    on_grid = sample < n * n
    cell_y = sample // n
    cell_x = sample - cell_y * n
    a, b = rng.next_float32(), rng.next_float32()
    x = dr.select(on_grid, (mi.Float(cell_x) + a) / mi.Float(n), a)
    y = dr.select(on_grid, (mi.Float(cell_y) + b) / mi.Float(n), b)
    if camera.filter_sigma > 0:
        (spread,) = opaque(camera.filter_sigma * np.sqrt(2))
        # not quite -1 and 1, whose inverses are infinite
        x, y = (0.5 + spread * dr.erfinv((2 - 2**-22) * p - (1 - 2**-23)) for p in (x, y))
    width = opaque_index(camera.width)
    row = pixel // width
    column = pixel - row * width
    return camera_rays(camera, mi.Float(column) + x, mi.Float(row) + y)


@dataclass(frozen=True)
class Wave:
    """Camera paths in flight: `rays`, random streams, each's slot in `pixels` and its sample."""

    rays: Any
    rng: Any
    slot: Any
    sample: Any


def wave(
    camera: Camera, pixels: Any, slots: int, first: int, count: int, spp: int, *seeds: int
) -> Wave:
    """Samples `first` to `first + count` of `spp` of each of the `slots` Dr.Jit `pixels`."""
    size = opaque_index(slots)
    lane = dr.arange(mi.UInt32, count * slots)
    sample = lane // size
    slot = lane - sample * size
    rng = stream(count * slots, *seeds, first)
    pixel = dr.gather(mi.UInt32, pixels, slot)
    sample = sample + opaque_index(first)
    return Wave(jittered(camera, pixel, sample, spp, rng), rng, slot, sample)


def each_sample(
    camera: Camera,
    pixels: Any,
    slots: int,
    spp: int,
    seed: int,
    trace: Callable[[Wave], None],
) -> None:
    """Call `trace` with samples 0 to `spp` of each of the `slots` Dr.Jit `pixels`, one at a time.

    A loop inside the kernel, so that the order of a pixel's floating-point sums, and so the bytes,
    are the same on every run. `trace` is called once, with symbolic variables.
    """
    slot = dr.arange(mi.UInt32, slots)
    size, end = opaque_index(slots), opaque_index(spp)
    start = seed_state(seed)

    def more(sample: Any) -> Any:
        return sample < end

    def body(sample: Any) -> Any:
        lane = mi.UInt64(sample) * mi.UInt64(size) + mi.UInt64(slot)
        rng = stream_of(start, lane)
        pixel = dr.gather(mi.UInt32, pixels, slot)
        trace(Wave(jittered(camera, pixel, sample, spp, rng), rng, slot, sample))
        return (sample + 1,)

    dr.while_loop((dr.zeros(mi.UInt32, slots),), more, body, label="samples of a pixel")

"""One-light-at-a-time images: each camera path is traced once for many lights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from appearance.render.coverage import covered_pixels
from appearance.render.paths import Surface, opaque_index, passes, pixel_indices, walk, wave
from appearance.scene import HairScene, light_arrays
from reconstruction.cameras import Camera
from reconstruction.lights import Light

_LANES = 1 << 20  # paths in flight: enough to fill the machine, little enough memory


def render_olat(
    scene: HairScene,
    camera: Camera,
    lights: Sequence[Light],
    *,
    spp: int = 32,
    max_depth: int = 16,
    seed: int = 0,
    pixels: ArrayLike | None = None,
    first_lights: int | None = None,
    deep_lights: int = 8,
    rr_depth: int = 4,
    film_bytes: int = 1 << 29,
) -> NDArray[np.float32]:
    """Radiance under each of `lights` alone, W/(sr m²) at full level.

    Returns `(L, P, 3)` for `pixels (P,)` (flat indices), or `(L, H, W, 3)` without `pixels`: then
    a cheap pass finds the pixels that see the subject and only those are traced. `spp` paths a pixel
    serve all lights; each vertex up to `max_depth` segments from the camera (1 is direct light)
    asks a systematic sample of the lights, with a random start a vertex, and weights it by L/k:
    `first_lights` at the first vertex (all of them by default), `deep_lights` after it. The
    estimate is unbiased for every choice of these numbers, and for Russian roulette from vertex
    `rr_depth` on. Pixels are tiled so that the film stays under `film_bytes`. Same arguments,
    same bytes.
    """
    if spp < 1 or max_depth < 1 or deep_lights < 1:
        raise ValueError(
            f"spp, max_depth and deep_lights must be positive, got {spp}, {max_depth}, {deep_lights}"
        )
    shape = (len(lights), camera.height, camera.width, 3)
    if pixels is None:
        index = covered_pixels(scene, camera)
        image = np.zeros((len(lights), camera.height * camera.width, 3), np.float32)
    else:
        index = pixel_indices(camera, pixels)
        image = np.zeros((len(lights), len(index), 3), np.float32)
    if not len(lights) or not len(index):
        return image.reshape(shape) if pixels is None else image
    counts = (
        min(first_lights or len(lights), len(lights)),
        min(deep_lights, len(lights)),
    )
    tile = max(1, min(len(index), film_bytes // (12 * len(lights)), _LANES))
    for start in range(0, len(index), tile):
        part = index[start : start + tile]
        radiance = _render_tile(
            scene, camera, lights, part, spp, max_depth, (seed, start), counts, rr_depth
        )
        if pixels is None:
            image[:, part] = radiance
        else:
            image[:, start : start + tile] = radiance
    return image.reshape(shape) if pixels is None else image


def _render_tile(
    scene: HairScene,
    camera: Camera,
    lights: Sequence[Light],
    index: NDArray[np.int64],
    spp: int,
    max_depth: int,
    seed: tuple[int, int],
    counts: tuple[int, int],
    rr_depth: int,
) -> NDArray[np.float32]:
    """Mean over `spp` paths a pixel: `(L, P, 3)`."""
    import drjit as dr
    import mitsuba as mi

    position, intensity = light_arrays(lights)
    bank = _Bank(mi.Float(position.ravel()), mi.Float(intensity.ravel()), len(lights))
    pixel = mi.UInt32(index.astype(np.uint32))
    film = dr.zeros(mi.Float, 3 * len(lights) * len(index))
    surface = Surface(scene)
    for first, count in passes(spp, max(1, _LANES // len(index))):
        paths = wave(camera, pixel, len(index), first, count, spp, *seed)
        gather = _Gather(surface, film, paths.slot, opaque_index(len(index)), bank, counts)
        walk(surface, paths.rays, paths.rng, gather, max_depth, rr_depth)
        dr.eval(film)
    image = np.array(film).reshape(len(lights), len(index), 3)
    return np.asarray(image / np.float32(spp), dtype=np.float32)


@dataclass(frozen=True)
class _Bank:
    """The lights on the device: `(3 L,)` each, in scene units."""

    positions: Any
    intensities: Any
    count: int


@dataclass(frozen=True)
class _Gather:
    """Light from a systematic sample of the bank at a path's vertex, with a random start."""

    surface: Surface
    film: Any
    slot: Any
    slots: Any
    bank: _Bank
    counts: tuple[int, int]

    def __call__(self, si: Any, throughput: Any, rng: Any, first: bool, active: Any) -> None:
        import drjit as dr
        import mitsuba as mi

        count = self.counts[0] if first else self.counts[1]
        total = self.bank.count
        stride = total / count
        start = rng.next_float32() * stride

        def more(j: Any) -> Any:
            return j < count

        def body(j: Any) -> Any:
            light = j
            if count < total:
                light = dr.minimum(mi.UInt32(mi.Float(j) * stride + start), total - 1)
            self._add(si, throughput * stride, light, active)
            return (j + 1,)

        dr.while_loop((mi.UInt32(0),), more, body, label="lights of a vertex")

    def _add(self, si: Any, throughput: Any, light: Any, active: Any) -> None:
        import drjit as dr
        import mitsuba as mi

        target = dr.gather(mi.Point3f, self.bank.positions, light, active)
        towards = target - si.p
        squared = dr.squared_norm(towards)
        wo = si.to_local(towards * dr.rsqrt(squared))
        value = throughput * self.surface.eval(si, wo, active)
        value *= dr.gather(mi.Color3f, self.bank.intensities, light, active) / squared
        lit = active & (dr.max(value) > 0)
        lit &= ~self.surface.scene.mi_scene.ray_test(si.spawn_ray_to(target), lit)
        put = (light * self.slots + self.slot) * 3
        for channel in range(3):
            dr.scatter_add(self.film, value[channel], put + channel, lit)

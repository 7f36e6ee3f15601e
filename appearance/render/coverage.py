"""Which pixels see the subject, and what of it."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from appearance.render.paths import Surface, pixel_indices, wave
from appearance.scene.hair_scene import SCALE, HairScene
from appearance.scene.opaque import opaque
from reconstruction import Camera
from reconstruction.array_backend import for_kernels
from reconstruction.arrays import AnyFloats, Bools, Floats, Ints

FUZZ = 0.005
"""Metres of hair before a point that do not hide it: strands are porous, and off by as much."""


def coverage(scene: HairScene, camera: Camera, spp: int = 16, seed: int = 0) -> dict[str, Floats]:
    """Share of each pixel that shows `"hair"` and `"head"`: two images `(H, W)` in [0, 1]."""
    size = camera.height, camera.width
    shares = pixel_coverage(scene, camera, np.arange(size[0] * size[1]), spp, seed)
    return {name: share.reshape(size) for name, share in shares.items()}


def pixel_coverage(
    scene: HairScene, camera: Camera, pixels: ArrayLike, spp: int = 16, seed: int = 0
) -> dict[str, Floats]:
    """`coverage` of some pixels, flat indices `(P,)`: two of `(P,)`, however large the image."""
    if spp < 1:
        raise ValueError(f"spp must be positive, got {spp}")
    index = pixel_indices(camera, pixels)
    size = len(index)
    if not size:
        return {name: np.zeros(0, np.float32) for name in ("hair", "head")}
    paths = wave(camera, mi.UInt32(index), size, 0, spp, spp, seed)
    surface = Surface(scene)
    pi = scene.mi_scene.ray_intersect_preliminary(paths.rays, coherent=True)
    hit = pi.is_valid()
    hair = hit & surface.is_hair(pi)
    counts = {name: dr.zeros(mi.UInt32, size) for name in ("hair", "head")}
    for name, mask in (("hair", hair), ("head", hit & ~hair)):
        dr.scatter_add(counts[name], mi.UInt32(1), paths.slot, mask)
    dr.eval(counts)  # one tracing for both
    out = {name: np.array(x, np.float32) / np.float32(spp) for name, x in counts.items()}
    return out


def covered_pixels(scene: HairScene, camera: Camera, spp: int = 9) -> Ints:
    """Flat indices `(P,)` of the pixels that see the subject in at least one of `spp` samples.

    A pixel that the subject covers by less than 1/`spp` may be left out, and reads as background.
    """
    shares = coverage(scene, camera, spp)
    return np.flatnonzero((shares["hair"] + shares["head"]).ravel() > 0)


def sees(scene: HairScene, camera: Camera, points: AnyFloats) -> Bools:
    """Whether nothing but `FUZZ` lies between `points (P, 3)`, metres, and the camera `(P,)`."""
    way = camera.center - points
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    start, end = ((points + FUZZ * way) * SCALE).T, camera.center * SCALE
    origin = mi.Point3f(*(mi.Float(for_kernels(x)) for x in start))
    towards = mi.Vector3f(*opaque(end)) - mi.Vector3f(origin)
    ray = mi.Ray3f(origin, dr.normalize(towards))
    ray.maxt = dr.norm(towards)
    return ~np.array(scene.occluded(ray), dtype=bool)

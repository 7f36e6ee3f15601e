"""Which pixels see the subject, and what of it."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance.render.paths import Surface, wave
from appearance.scene.hair_scene import HairScene
from reconstruction import Camera
from reconstruction.arrays import Floats, Ints


def coverage(scene: HairScene, camera: Camera, spp: int = 16, seed: int = 0) -> dict[str, Floats]:
    """Share of each pixel that shows `"hair"` and `"head"`: two images `(H, W)` in [0, 1]."""
    if spp < 1:
        raise ValueError(f"spp must be positive, got {spp}")
    size = camera.width * camera.height
    paths = wave(camera, dr.arange(mi.UInt32, size), size, 0, spp, spp, seed)
    surface = Surface(scene)
    pi = scene.mi_scene.ray_intersect_preliminary(paths.rays, coherent=True)
    hit = pi.is_valid()
    hair = hit & surface.is_hair(pi)
    out = {}
    for name, mask in (("hair", hair), ("head", hit & ~hair)):
        count = dr.zeros(mi.UInt32, size)
        dr.scatter_add(count, mi.UInt32(1), paths.slot, mask)
        share = np.array(count, dtype=np.float32) / np.float32(spp)
        out[name] = share.reshape(camera.height, camera.width)
    return out


def covered_pixels(scene: HairScene, camera: Camera, spp: int = 9) -> Ints:
    """Flat indices `(P,)` of the pixels that see the subject in at least one of `spp` samples.

    A pixel that the subject covers by less than 1/`spp` may be left out, and reads as background.
    """
    shares = coverage(scene, camera, spp)
    return np.flatnonzero((shares["hair"] + shares["head"]).ravel() > 0)

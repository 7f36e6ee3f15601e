"""OLAT images for looking at: light from the first hit as it is, the rest smoothed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from appearance.render.coverage import coverage
from appearance.render.olat import render_olat
from appearance.scene import HairScene
from reconstruction.cameras import Camera
from reconstruction.lights import Light


def render_smoothed(
    scene: HairScene,
    camera: Camera,
    lights: Sequence[Light],
    *,
    spp: int = 36,
    max_depth: int = 16,
    sigma: float = 1.5,
    seed: int = 0,
) -> NDArray[np.float32]:
    """Radiance `(L, H, W, 3)` under each of `lights` alone, W/(sr m²), without fireflies.

    Light that a fibre sends on from another fibre has been spread by every hit before it: it varies
    slowly over the image and carries nearly all of the noise. It is averaged over a Gaussian of
    `sigma` pixels, hair and head apart, each by its share of the pixels, so that nothing leaks over
    an edge. Direct light, with the strands' highlights and shadows, is left as it is. `render_olat`
    is the unbiased reference; what differs is noise there and bias of the smoothing here.
    """
    if not sigma > 0:
        raise ValueError(f"sigma must be positive, got {sigma}")
    share = coverage(scene, camera, max(spp, 16), seed)
    covered = np.flatnonzero((share["hair"] + share["head"]).ravel() > 0)
    out = np.zeros((len(lights), camera.height * camera.width, 3), np.float32)
    # the first hits and their light are the same in both: they draw the same random numbers first
    first, whole = (
        render_olat(
            scene,
            camera,
            lights,
            spp=spp,
            max_depth=depth,
            deep_lights=max(len(lights), 1),
            seed=seed,
            pixels=covered,
        )
        for depth in (1, max_depth)
    )
    out[:, covered] = whole - first
    deep = out.reshape(len(lights), camera.height, camera.width, 3)
    smooth = np.zeros_like(deep)
    is_hair = share["hair"] >= share["head"]
    for kind, mask in (("hair", is_hair), ("head", ~is_hair)):
        weight = share[kind] * mask
        total = gaussian_filter(weight.astype(np.float64), sigma, mode="constant")
        over = np.divide(weight, total, out=np.zeros_like(total), where=total > 1e-6)
        mixed = gaussian_filter(
            (deep * mask[..., None]).astype(np.float64), (0, sigma, sigma, 0), mode="constant"
        )
        smooth += (mixed * over[..., None]).astype(np.float32)
    result = smooth.reshape(len(lights), -1, 3)
    result[:, covered] += first
    return result.reshape(len(lights), camera.height, camera.width, 3)

"""Images with smoothed indirect light.

Indirect light varies slowly over the image and has nearly all of the noise. It is filtered by a
Gaussian, separately for hair and head, each by its share of the pixels. Direct light, with
highlights and shadows, is not filtered. The renderers without smoothing are the unbiased reference.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter, maximum_filter

from appearance.render.coverage import coverage, covered_pixels
from appearance.render.environment import direct_environment, indirect_environment
from appearance.render.harmonics import projected
from appearance.render.olat import (
    FILM_BYTES,
    OlatOptions,
    render_direct,
    render_indirect,
    spread_out,
)
from appearance.render.paths import pixel_indices
from appearance.render.pixel_field import field_of
from appearance.render.tracing import LANE_BYTES, Sampling
from appearance.scene.hair_scene import HairScene
from reconstruction import Camera, Light
from reconstruction.arrays import AnyFloats, Floats, Ints
from reconstruction.geometry.lights import Lighting, components, mixed

SIGMA = 1.25
"""Standard deviation, pixels, of the filter of indirect light."""
AREA = 20
"""Pixels that this filter averages over: 4 pi `SIGMA`²."""
_WIDE = 4.0
"""Factor on it for the light of rare bright paths."""
_RARE = 2.0
"""Multiple of the mean over the wide window above which light is that of a rare path."""
_AT_A_TIME = 16
"""Lights whose full images are in memory at once."""
DIRECT = 36
"""Least number of paths a pixel of direct light, each a quarter of the cost of a full path."""
THRIFT = 6.0
"""`OlatOptions.thrift` of indirect light: 0.1 dB less than at 3, for a fifth less time."""
_DIRECT_OF_MAPS = 10.0
"""Paths a pixel of a map's direct light over the square root of those of indirect light: three
times less error than that of indirect light, which falls slowly with paths."""
_SIGMA_OF_MAPS, _NARROWER = 3.2, 0.3
"""Filter of a map's indirect light at one path a pixel, and the power by which paths narrow it.
Within 0.2 dB of the least error from 1 to 32 paths, on pixels of 0.5 and 1.9 mm."""
SHOWN = Sampling(36, 16)


def olat_smoothed(
    scene: HairScene,
    camera: Camera,
    lights: Sequence[Lighting],
    sampling: Sampling = SHOWN,
    *,
    pixels: ArrayLike | None = None,
) -> Floats:
    """`render_olat` with its indirect light smoothed over `SIGMA` pixels.

    Returns `(L, H, W, 3)`, or `(L, P, 3)` for the flat `pixels (P,)`. Indirect light, of
    `sampling.spp` paths a pixel, is rendered wherever the subject is; direct light
    (`render_direct`) in these pixels only, by twice as many paths, at least `DIRECT`. Where it
    takes fewer paths, indirect light is not smoothed: few pixels have more paths for its noise.
    """
    lights, mix = components(lights)
    field_on, scene = scene, replace(scene, field=None)  # what is smooth is the material's
    wanted = None if pixels is None else pixel_indices(camera, pixels)
    if wanted is not None and AREA * len(wanted) < len(covered_pixels(scene, camera, 1)):
        out = render_indirect(scene, camera, lights, wanted, **_of_indirect(sampling, AREA))
    else:
        wanted, out = _smoothed_indirect(scene, camera, lights, wanted, sampling)
    direct = max(2 * sampling.spp, DIRECT)
    seed = sampling.seed + (1 << 31)
    out += render_direct(scene, camera, lights, wanted, spp=direct, seed=seed, thrift=1.0)
    field = field_of(field_on, camera, wanted)
    if field is not None:
        out = field.lit(out, lights)
    out = mixed(mix, out)
    return out if pixels is not None else spread_out(out, wanted, camera)


def _smoothed_indirect(
    scene: HairScene,
    camera: Camera,
    lights: Sequence[Light],
    wanted: Ints | None,
    sampling: Sampling,
) -> tuple[Ints, Floats]:
    """Smoothed indirect light `(L, P, 3)` of the flat pixels `wanted (P,)`, and these pixels.

    None: all that see the subject.
    """
    share = coverage(scene, camera, max(sampling.spp, 16), sampling.seed)
    sees = (share["hair"] + share["head"]).ravel() > 0
    wanted = np.flatnonzero(sees) if wanted is None else wanted
    sees[wanted] = True
    index = np.flatnonzero(sees)
    rest = render_indirect(scene, camera, lights, index, **_of_indirect(sampling))
    out = np.empty((len(lights), len(wanted), 3), np.float32)
    for k in range(0, len(lights), _AT_A_TIME):
        part = slice(k, k + _AT_A_TIME)
        smooth = smoothed(spread_out(rest[part], index, camera), share, SIGMA)
        out[part] = smooth.reshape(len(smooth), -1, 3)[:, wanted]
    return wanted, out


def _of_indirect(sampling: Sampling, times: int = 1) -> dict[str, Any]:
    """Options of `render_indirect` with so many `times` the paths."""
    spp, depth, seed = times * sampling.spp, sampling.max_depth, sampling.seed
    return {"spp": spp, "max_depth": depth, "seed": seed, "thrift": THRIFT}


def memory_needed(camera: Camera, pixels: int, lights: int, wanted: int | None = None) -> float:
    """Approximate GB that `olat_smoothed` takes where `pixels` show the subject, beside the scene.

    Two arrays of radiance, that of the `wanted` pixels (default: all) and that of indirect light,
    and the largest of a copy, a tile of paths, and the blurred full images.
    """
    radiance = 12 * lights * pixels
    share = 1.0 if wanted is None else wanted / max(pixels, 1)
    tile = min(pixels * (FILM_BYTES * lights + LANE_BYTES), OlatOptions().memory)
    blurred = 12 * min(lights, _AT_A_TIME) * (2 * camera.width * camera.height + 7 * pixels)
    return ((1 + share) * radiance + max(tile, blurred, radiance)) / 1e9


def environment_smoothed(
    scene: HairScene, camera: Camera, envmap: AnyFloats, sampling: Sampling = SHOWN
) -> Floats:
    """`render_environment` with its indirect light smoothed: `(H, W, 3)`.

    `envmap (h, w, 3)`. The more paths, the narrower the filter: 3.2 pixels at one path a pixel, 1.1
    at 32. Direct light has `_DIRECT_OF_MAPS` times the square root of `spp` paths a pixel; light
    that only one half of them sampled is spread (`without_rare`).
    """
    spp, seed = sampling.spp, sampling.seed
    share = coverage(scene, camera, seed=seed)
    index = np.flatnonzero((share["hair"] + share["head"]).ravel() > 0)
    indirect = indirect_environment(scene, camera, envmap, sampling, index)
    half = round(_DIRECT_OF_MAPS * spp**0.5 / 2)
    one, other = (
        direct_environment(scene, camera, envmap, half, 2 * seed + k, pixels=index) for k in (1, 2)
    )
    sigma = _SIGMA_OF_MAPS * spp**-_NARROWER
    # a field has the detail of single strands: what is smooth is the light without it
    factor = mean_factor(scene, camera, envmap, index)
    smooth = smoothed((indirect / factor)[None], share, sigma)[0]
    return np.asarray(without_rare(one, other, share, sigma) + factor * smooth)


def mean_factor(scene: HairScene, camera: Camera, envmap: AnyFloats, pixels: Ints) -> Floats:
    """Approximate factor of the scene's field on an environment's light `(H, W, 3)`, at flat
    `pixels (P,)`; 1 elsewhere."""
    out = np.ones((camera.height, camera.width, 3), np.float32)
    field = field_of(scene, camera, pixels)
    if field is not None and not field.additive:
        integrals = projected(envmap, 0.0, field.degree)
        out.reshape(-1, 3)[pixels] = field.mean_factor(integrals)
    return out


def without_rare(one: Floats, other: Floats, share: dict[str, Floats], sigma: float) -> Floats:
    """The mean of two independent images `(H, W, 3)`, without rare bright paths.

    The excess of a pixel over all nine neighbours in the other image is a rare path's, and spread
    over `sigma` pixels (see `smoothed`), which keeps the sum.
    """
    highest_one, highest_other = (maximum_filter(x, (3, 3, 1)) for x in (one, other))
    usual = 0.5 * (np.minimum(one, highest_other) + np.minimum(other, highest_one))
    return usual + smoothed((0.5 * (one + other) - usual)[None], share, sigma)[0]


def smoothed(images: Floats, share: dict[str, Floats], sigma: float) -> Floats:
    """`images (L, H, W, 3)` averaged over `sigma` pixels, hair and head apart.

    `share` is the result of `coverage`. A pixel belongs to what covers more of it, and gets the
    local mean of that, by area, times its own share. The excess over twice the mean over 4 `sigma`
    is averaged over 4 `sigma`. Raises `ValueError` for `sigma` <= 0.
    """
    if not sigma > 0:
        raise ValueError(f"sigma must be positive, got {sigma}")
    out = np.zeros(images.shape, np.float32)
    is_hair = share["hair"] >= share["head"]
    for kind, mask in (("hair", is_hair), ("head", ~is_hair)):
        weight = (share[kind] * mask).astype(np.float32)[None]
        if not weight.any():
            continue
        rows, columns = (np.flatnonzero(weight.any(axis=(0, axis))) for axis in (2, 1))
        box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        part = (slice(None), *box)
        light = images[part] * np.broadcast_to(mask, images.shape[:3])[part][..., None]
        out[part] += _without_blots(light, weight[part], sigma)
    return out


def _without_blots(light: Floats, weight: Floats, sigma: float) -> Floats:
    """The local mean of `light (L, H, W, 3)`, with rare light over a wider window."""
    peak = light.max(axis=-1, keepdims=True)
    usual = light * np.minimum(
        1.0, _RARE * _local_mean(peak, weight, _WIDE * sigma) / np.maximum(peak, 1e-30)
    )
    return _local_mean(usual, weight, sigma) + _local_mean(light - usual, weight, _WIDE * sigma)


def _local_mean(light: Floats, weight: Floats, sigma: float) -> Floats:
    """Gaussian mean of `light (L, H, W, C)` per `weight (1, H, W)`, times the weight."""
    area = gaussian_filter(weight, (0, sigma, sigma), mode="constant", truncate=3.0)
    over = np.divide(weight, area, out=np.zeros_like(area), where=weight > 0)
    mixed = gaussian_filter(light, (0, sigma, sigma, 0), mode="constant", truncate=3.0)
    return np.asarray(mixed * over[..., None], np.float32)

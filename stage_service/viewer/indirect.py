"""Light between fibres, and on from the skin, traced beforehand: a grid for the shader."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.ndimage import gaussian_filter

from appearance import HairScene
from appearance.render.coverage import covered_pixels
from appearance.render.harmonics import count_of, degrees, harmonics
from appearance.render.olat import render_olat_parts
from appearance.render.paths import wave
from appearance.scene.hair_scene import SCALE
from reconstruction import Camera, Light
from reconstruction.arrays import Array, Floats, Ints
from reconstruction.geometry.lights import dome_positions
from reconstruction.options import Count, options

DEGREE = 3
"""Of the harmonics over the light's direction."""
_RIDGE = 0.03
_FIELD_DEG = 30.0
_REACHES = ((1.6, 1.0), (4.0, 1e-2), (8.0, 1e-4))
"""Cells that values are averaged over, and how much each mean weighs: the wider ones only count
where nothing was seen nearer."""
_RAYS = 4
"""A pixel, for the mean place of what it sees."""


@options
class BakeOptions:
    """Pictures of `size` pixels a side from `views` sides under `lights` of the rig, `spp` paths a
    pixel of at most `max_depth` vertices; a grid of `cells` a side."""

    size: Count = 40
    views: Count = 12
    lights: Annotated[int, Field(ge=count_of(DEGREE))] = 32
    spp: Count = 32
    max_depth: Count = 24
    cells: Count = 24


@dataclass(frozen=True, eq=False)
class IndirectLight:
    """`values (n, n, n, 16, 3)`, z, y, x, harmonic, colour; radiance that leaves a place towards
    the eye for a light of irradiance 1 at the origin, in the mean over the sides it is seen from.

    The cells' middles go from `low (3,)` to `high (3,)`, metres.
    """

    low: Array
    high: Array
    values: NDArray[np.float16]

    def lit(self, directions: Array, irradiance: Array) -> Floats:
        """Radiance `(n, n, n, 3)` for lights in `directions (L, 3)` of any length, whose
        `irradiance (L, 3)` at the origin is that of a surface turned to them."""
        shape = np.einsum("lk,lc->kc", harmonics(directions, DEGREE), irradiance)
        values = self.values.astype(np.float32)
        return np.maximum(np.einsum("zyxkc,kc->zyxc", values, shape.astype(np.float32)), 0)


def bake(
    scene: HairScene, box: tuple[Array, Array], lights: Sequence[Light], options: BakeOptions
) -> IndirectLight:
    """Trace what light does after its first hit, and average it over cells of `box` (low, high).

    Each pixel's radiance under each light, less the direct, is put at the mean place of what it
    sees, as coefficients of harmonics over the light's direction (least squares). Cells that
    nothing was seen in have their neighbours' mean.
    """
    low, high = box
    chosen = _spread(lights, options.lights)
    way = np.array([x.position for x in chosen])
    power = np.array([x.intensity_towards(np.zeros(3)) / (x.position @ x.position) for x in chosen])
    basis = harmonics(way, DEGREE).astype(float)
    ridge = _RIDGE * len(way) * np.diag(degrees(DEGREE) ** 2) / (4 * np.pi)
    solve = np.linalg.solve(basis.T @ basis + ridge, basis.T)
    n, terms = options.cells, basis.shape[1]
    total, weight = np.zeros((n**3, terms * 3)), np.zeros(n**3)
    for k, camera in enumerate(_cameras(low, high, options)):
        pixels = covered_pixels(scene, camera)
        if not len(pixels):
            continue
        places, share = mean_places(scene, camera, pixels, k)
        seen = share > 0.3
        pixels, places, share = pixels[seen], places[seen], share[seen]
        how = {"spp": options.spp, "max_depth": options.max_depth, "seed": k}
        indirect = render_olat_parts(scene, camera, chosen, pixels, **how)[1]
        found = np.einsum("kl,lpc->pkc", solve, indirect / power[:, None, :])
        cell = (places - low) / (high - low) * (n - 1)
        for at, part in _corners(cell, n):
            # not divided by the share: what is seen half weighs half
            np.add.at(total, at, part[:, None] * found.reshape(len(found), -1))
            np.add.at(weight, at, part * share)
    if not weight.any():
        return IndirectLight(low, high, np.zeros((n, n, n, terms, 3), np.float16))
    grid, amount = total.reshape(n, n, n, -1), weight.reshape(n, n, n, 1)
    top, bottom = np.zeros_like(grid), np.zeros_like(amount)
    for sigma, much in _REACHES:
        top += much * gaussian_filter(grid, (sigma,) * 3 + (0,))
        bottom += much * gaussian_filter(amount, (sigma,) * 3 + (0,))
    mean = total.sum(axis=0) / weight.sum()
    tiny = 1e-9 * weight.max()
    values = (top + tiny * mean) / (bottom + tiny)
    return IndirectLight(low, high, values.reshape(n, n, n, terms, 3).astype(np.float16))


def _spread(lights: Sequence[Light], count: int) -> list[Light]:
    """Some of the lights, each as far as can be from those before."""
    way = np.array([x.position / np.linalg.norm(x.position) for x in lights])
    chosen = [0]
    near = way @ way[0]
    while len(chosen) < min(count, len(lights)):
        chosen.append(int(near.argmin()))
        near = np.maximum(near, way @ way[chosen[-1]])
    return [lights[i] for i in chosen]


def _cameras(low: Array, high: Array, options: BakeOptions) -> list[Camera]:
    middle, reach = (low + high) / 2, np.linalg.norm(high - low) / 2
    size, half = options.size, np.radians(_FIELD_DEG / 2)
    focal = size / 2 / np.tan(half)
    K = np.array([[focal, 0, (size - 1) / 2], [0, focal, (size - 1) / 2], [0, 0, 1.0]])
    out = []
    for i, eye in enumerate(dome_positions(options.views, reach / np.sin(half), -40)):
        forward = -eye / np.linalg.norm(eye)
        right = np.cross(forward, [0, 0, 1] if abs(forward[2]) < 0.95 else [1, 0, 0])
        right /= np.linalg.norm(right)
        R = np.stack([right, np.cross(forward, right), forward])
        out.append(Camera(f"bake_{i}", size, size, K, R, -R @ (middle + eye)))
    return out


def mean_places(scene: HairScene, camera: Camera, pixels: Ints, seed: int) -> tuple[Array, Array]:
    """The mean place of what each pixel sees `(P, 3)`, metres, and the share that does `(P,)`."""
    count = len(pixels)
    paths = wave(camera, mi.UInt32(pixels.astype(np.uint32)), count, 0, _RAYS, _RAYS, seed)
    si = scene.mi_scene.ray_intersect(paths.rays)
    valid = si.is_valid()
    sums = [dr.zeros(mi.Float, count) for _ in range(4)]
    for target, value in zip(sums, (si.p.x, si.p.y, si.p.z, mi.Float(1)), strict=True):
        dr.scatter_add(target, value, paths.slot, valid)
    x, y, z, n = (np.array(s, dtype=float) for s in sums)
    places = np.stack([x, y, z], axis=-1) / np.maximum(n, 1)[:, None] / SCALE
    return places, n / _RAYS


def _corners(cell: Array, n: int) -> list[tuple[Ints, Array]]:
    """The eight cells about each place `(P, 3)` of a grid of `n` a side: index and share."""
    cell = np.clip(cell, 0, n - 1 - 1e-6)
    base = cell.astype(int)
    rest = cell - base
    out = []
    for k in range(8):
        step = np.array([k & 1, k >> 1 & 1, k >> 2 & 1])
        x, y, z = (base + step).T
        out.append(((z * n + y) * n + x, np.where(step, rest, 1 - rest).prod(axis=1)))
    return out

"""Light between fibres, and on from the skin, traced beforehand: a grid for the page to look up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.sparse import csr_matrix

from appearance import HairScene
from appearance.render.coverage import covered_pixels
from appearance.render.harmonics import count_of, degrees, harmonics
from appearance.render.olat import render_indirect
from appearance.render.paths import wave
from appearance.scene.hair_scene import SCALE
from reconstruction import Camera, Light
from reconstruction.arrays import Array, Floats, Ints
from reconstruction.geometry.lights import dome_positions
from reconstruction.options import Count, options

DEGREE = 2
"""Of the harmonics over the direction that light leaves in."""
_RIDGE = 0.03
_FIELD_DEG = 30.0
_REACHES = ((0.8, 1.0), (1.6, 0.05), (4.0, 1e-3), (8.0, 1e-5))
"""Cells that values are averaged over, and how much each mean weighs: the wider ones only count
where little was seen nearer."""
_BRIGHTEST = 10.0
"""Times the mean of pixels about it, beyond which one has seen a rare bright path."""
_ABOUT = ((2.0, 1.0), (6.0, 1e-2))
_ALIKE, _OWN = 0.6, 0.03
"""Radians over which lights make much the same of hair, and the share that each has of its own."""
_RAYS = 4
"""A pixel, for the mean place of what it sees."""
_ROWS = 512
"""Cells that are averaged at a time."""


@options
class BakeOptions:
    """Pictures of `size` pixels a side from `views` sides under `lights` of the rig, `spp` paths a
    pixel of at most `max_depth` vertices; a grid of `cells` a side."""

    size: Count = 40
    views: Count = 48
    lights: Count = 64
    spp: Count = 24
    max_depth: Count = 24
    cells: Count = 24


@dataclass(frozen=True, eq=False)
class IndirectLight:
    """`values (M, L, 9, 3)`, cell, light, harmonic over the direction in which light leaves,
    colour: radiance for each of the lights in `directions (L, 3)`, of irradiance 1 at the origin.

    `cells (n, n, n)`, z, y, x, says which of the M each has: its own, or its nearest's where
    nothing was seen. Their middles go from `low (3,)` to `high (3,)`, metres.
    """

    low: Array
    high: Array
    directions: Array
    cells: Ints
    values: NDArray[np.float16]

    def lit(self, directions: Array, irradiance: Array) -> Floats:
        """Coefficients `(n, n, n, 9, 3)` of the radiance for lights in `directions (Q, 3)` of any
        length, whose `irradiance (Q, 3)` at the origin is that of a surface turned to them."""
        shares = between_lights(self.directions, directions).T @ irradiance
        found = np.einsum("mlkc,lc->mkc", self.values, shares.astype(np.float32))
        return np.asarray(found[self.cells], np.float32)


def between_lights(known: Array, wanted: Array) -> Array:
    """What each light of `known (L, 3)` tells of those of `wanted (Q, 3)`: weights `(Q, L)`, whose
    sum is 1. Kriging about the mean with a covariance of exp((cos - 1) / 0.6²)."""
    u, v = (x / np.linalg.norm(x, axis=-1, keepdims=True) for x in (known, wanted))
    alike = np.exp((u @ u.T - 1) / _ALIKE**2) + _OWN * np.eye(len(u))
    weights = np.linalg.solve(alike, np.exp((u @ v.T - 1) / _ALIKE**2)).T
    return np.asarray(weights + (1 - weights.sum(axis=1, keepdims=True)) / len(u))


def bake(
    scene: HairScene, box: tuple[Array, Array], lights: Sequence[Light], options: BakeOptions
) -> IndirectLight:
    """Trace what light does after its first hit, and average it over cells of `box` (low, high).

    Each pixel's radiance under each light, less the direct, is put at the mean place of what it
    sees; a cell's coefficients are those of least squares over the directions it was seen from.
    """
    (low, high), origin = box, np.zeros(3)
    # of a red lamp nothing is learnt of green, and all that is told is over the irradiance
    white = [replace(x, intensity=np.ones(3)) for x in lights]
    chosen = _spread(
        [x for x in white if x.intensity_towards(origin).any()] or white, options.lights
    )
    way = np.array([x.position for x in chosen])
    power = np.array([x.intensity_towards(origin) / (x.position @ x.position) for x in chosen])
    power[power == 0] = 1
    n = options.cells
    seen = [
        _seen(scene, camera, chosen, options, k)
        for k, camera in enumerate(_cameras(low, high, options))
    ]
    places, towards, share, radiance = (np.concatenate(x) for x in zip(*seen, strict=True))
    if not len(places):
        none = np.zeros((1, len(chosen), count_of(DEGREE), 3), np.float16)
        return IndirectLight(low, high, way, np.zeros((n, n, n), int), none)
    radiance /= power.astype(np.float32)
    corners = _corners((places - low) / (high - low) * (n - 1), n)
    kept, row = np.unique(np.concatenate([at for at, _ in corners]), return_inverse=True)
    part = np.concatenate([x for _, x in corners]).astype(np.float32)
    rays = np.tile(np.arange(len(places)), len(corners))
    put = csr_matrix((part, (row, rays)), (len(kept), len(places)))
    radiance = _without_rare(put, kept, n, share, radiance)
    values = _fitted(put, kept, n, harmonics(towards, DEGREE), share, radiance)
    known = np.zeros(n**3, bool)
    known[kept] = True
    nearest = distance_transform_edt(
        ~known.reshape(n, n, n), return_distances=False, return_indices=True
    )
    cells = np.searchsorted(kept, np.ravel_multi_index(tuple(nearest), (n, n, n)))
    return IndirectLight(low, high, way, cells, values.astype(np.float16))


def _seen(
    scene: HairScene, camera: Camera, lights: list[Light], options: BakeOptions, seed: int
) -> tuple[Array, Array, Array, Floats]:
    """Of the pixels that see the subject: the mean place `(P, 3)`, the direction from there to the
    camera, the share of the pixel, and its indirect radiance `(P, L, 3)` under each light."""
    pixels = covered_pixels(scene, camera)
    if not len(pixels):
        return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros((0, len(lights), 3), "f4")
    places, share = mean_places(scene, camera, pixels, seed)
    much = share > 0.3
    pixels, places, share = pixels[much], places[much], share[much]
    how = {"spp": options.spp, "max_depth": options.max_depth, "seed": seed}
    indirect = render_indirect(scene, camera, lights, pixels, **how)
    return places, camera.center - places, share, indirect.transpose(1, 0, 2)


def _without_rare(put: csr_matrix, kept: Ints, n: int, share: Array, radiance: Floats) -> Floats:
    """`radiance (P, L, 3)` with no more of the single bright paths than cells about it bear out:
    one of them would be a spot of a centimetre."""
    flat = radiance.reshape(len(radiance), -1)
    sums = np.concatenate([put @ share[:, None].astype(np.float32), put @ flat], axis=1)
    means = _averaged(sums, kept, n, _ABOUT)
    about = put.T @ (means[:, 1:] / np.maximum(means[:, :1], 1e-9))
    return np.minimum(flat, _BRIGHTEST * about).reshape(radiance.shape)


def _fitted(
    put: csr_matrix, kept: Ints, n: int, basis: Floats, share: Array, radiance: Floats
) -> Floats:
    """Coefficients `(M, L, k, 3)` of least squares about each of the `kept` cells.

    `put (M, P)` says where the rays are. What is seen half weighs half, for `radiance (P, L, 3)`
    is that of whole pixels.
    """
    terms = basis.shape[1]
    square = basis[:, :, None] * basis[:, None, :] * share[:, None, None].astype(np.float32)
    flat = radiance.reshape(len(basis), -1)
    sums = [put @ square.reshape(len(basis), -1)]
    sums += [put @ (basis[:, k, None] * flat) for k in range(terms)]
    means = _averaged(np.concatenate(sums, axis=1), kept, n, _REACHES)
    left = means[:, : terms**2].reshape(-1, terms, terms)
    right = means[:, terms**2 :].reshape(len(left), terms, -1)
    ridge = _RIDGE * np.diag(degrees(DEGREE) ** 2) + 1e-6 * np.eye(terms)
    size = np.trace(left, axis1=1, axis2=2)[:, None, None] / terms
    found = np.linalg.solve(left + size * ridge, right)
    return np.asarray(found.reshape(len(found), terms, -1, 3).transpose(0, 2, 1, 3), np.float32)


def _averaged(sums: Floats, kept: Ints, n: int, reaches: tuple[tuple[float, float], ...]) -> Floats:
    """Sums `(M, C)` of the `kept` cells, averaged over their neighbours."""
    at = np.stack(np.unravel_index(kept, (n, n, n)), axis=-1).astype(np.float32)
    out = np.empty_like(sums)
    for first in range(0, len(at), _ROWS):
        rows = slice(first, first + _ROWS)
        apart = ((at[rows, None] - at[None]) ** 2).sum(axis=-1)
        near = sum(much / s**3 * np.exp(-apart / (2 * s * s)) for s, much in reaches)
        out[rows] = near @ sums
    return out


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

"""A first absorption for each group of strands: Sun's Algorithm 1 for every cell of the volume.

Each cell's colour C is scaled by the ratio of captured to rendered brightness of its pixels, a mean
over many pixels and lights with little noise. No gradients are needed.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import gaussian_filter

from appearance.bsdf.maps import HairMaps
from appearance.bsdf.parameters import StrandHit
from appearance.inverse_rendering.options import Effort
from appearance.inverse_rendering.problem import FitProblem
from appearance.inverse_rendering.unknowns import BRACKET, Raw, decode, encode_absorption
from appearance.observations import Observed
from appearance.render.paths import Surface, jittered, stream
from reconstruction.array_backend import for_kernels
from reconstruction.arrays import Array, Ints

Shape = tuple[int, int, int]
_RAYS, _ROUNDS = 8, 12
_PATHS = 100_000
"""Paths of a round, over all views."""
_WIDE = 0.02
"""Weight of a cell's far neighbours, which determine a cell without hits."""


def absorption_of_cells(
    problem: FitProblem,
    raw: Raw,
    gain: Array,
    effort: Effort,
    *,
    whole: int = 4,
    seed: int = 0,
) -> HairMaps:
    """The maps of `raw` with each cell's absorption scaled to its captured colour; `gain (L,)`.

    The first `whole` rounds take the full step, later ones a half, a third and so on (Robbins and
    Monro 1951). The light is the mean of the valid single lights of each pixel. A round traces
    100,000 paths: at most a quarter of `effort`'s paths a pixel, at least one.
    """
    pixels = sum(len(o.pixels) for o in problem.views)
    spp = int(np.clip(_PATHS // max(pixels, 1), 1, max(1, effort.spp // 4)))
    effort = replace(effort, spp=spp)
    maps = decode(raw)
    cells = [visible_cells(problem, o, maps.shape, seed) for o in problem.views]
    captured = [_mean(o, o.radiance.astype(float) * problem.scale) for o in problem.views]
    colour = np.exp(-BRACKET * np.sqrt(maps.sigma_a))
    for k in range(_ROUNDS):
        sums = np.zeros((2, *maps.shape, 3))
        trial = replace(maps, sigma_a=(np.log(colour) / BRACKET) ** 2)
        now = raw | {"sigma_a": encode_absorption(trial.sigma_a)}
        for i, o in enumerate(problem.views):
            picture_seed = (seed << 16) + 997 * k + i
            rendered = problem.render_all(now, gain, i, effort, picture_seed)
            for total, values in zip(sums, (captured[i], _mean(o, rendered)), strict=True):
                _add(total, cells[i], values)
        ratio = _smoothed(sums[0]) / np.maximum(_smoothed(sums[1]), 1e-12)
        step = np.clip(np.maximum(ratio, 1e-6), 0.4, 2.5)
        share = 1 / max(1, 2 + k - whole)
        colour = np.clip(colour * step**share, 1e-6, 0.995)
    return replace(maps, sigma_a=(np.log(colour) / BRACKET) ** 2)


def visible_cells(problem: FitProblem, o: Observed, shape: Shape, seed: int) -> Ints:
    """Cells that rays through the pixels meet first `(P, 8)`, as flat indices; -1 where none."""
    count = len(o.pixels) * _RAYS
    lane = dr.arange(mi.UInt32, count)
    slot = lane // _RAYS
    pixel = dr.gather(mi.UInt32, mi.UInt32(for_kernels(o.pixels, np.uint32)), slot)
    ray = jittered(o.camera, pixel, lane - slot * _RAYS, _RAYS, stream(count, seed, 77))
    surface = Surface(problem.mapped.scene)
    si = surface.interact(ray, mi.Bool(True))
    hair = si.is_valid() & surface.is_hair(si)
    on_strand = StrandHit(problem.mapped.coordinates, si, hair)
    found = hair, dr.select(hair, on_strand.along, 0), dr.select(hair, on_strand.strand, 0)
    dr.eval(found)  # one tracing for the three
    met, along, strand = map(np.array, found)
    layers, columns, rows = shape
    u, v = problem.mapped.root_uv[strand].T
    column = np.minimum((u * columns).astype(int), columns - 1)
    row = np.minimum((v * rows).astype(int), rows - 1)
    layer = np.rint(along * (layers - 1)).astype(int)
    cell = (layer * columns + column) * rows + row
    return np.where(met, cell, -1).reshape(-1, _RAYS)


def _mean(o: Observed, values: Array) -> Array:
    """Mean over the valid lights `(P, 3)` of `values (L, P, 3)`."""
    count = np.maximum(o.valid.sum(axis=0), 1)
    return np.asarray(np.where(o.valid[..., None], values, 0).sum(axis=0) / count[:, None])


def _add(total: Array, cells: Ints, values: Array) -> None:
    hit = cells >= 0
    np.add.at(
        total.reshape(-1, 3), cells[hit], np.repeat(values[:, None], _RAYS, axis=1)[hit] / _RAYS
    )


def _smoothed(total: Array) -> Array:
    near = gaussian_filter(total, (0.5, 0.6, 0.6, 0), mode="constant")
    wide = gaussian_filter(total, (2, 4, 4, 0), mode="constant")
    return np.asarray(near + _WIDE * (wide + total.mean(axis=(0, 1, 2))))

"""Edits of a fitted model: colour, of all hair or a wisp, roughness, length, other strands."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from appearance.bsdf.maps import HairMaps
from appearance.model.fitted_model import FittedModel
from reconstruction import Strands
from reconstruction.arrays import Array, Ints


def wisp_of(strands: ArrayLike, root_uv: Array, cells: tuple[int, int], soft: float = 0.0) -> Array:
    """A brush `(w, h)` in [0, 1]: the share of each cell's strands that are among `strands`.

    `strands` are indices; `root_uv (S, 2)` the places of all roots. `soft` blurs the brush by so
    many cells.
    """
    w, h = cells
    cell = _cell_of(root_uv, cells)
    chosen = np.asarray(strands, np.int64)
    count = np.bincount(cell, minlength=w * h)
    inside = np.bincount(cell[chosen], minlength=w * h)
    brush = np.divide(inside, count, out=np.zeros(w * h), where=count > 0).reshape(w, h)
    return np.clip(gaussian_filter(brush, soft), 0, 1) if soft > 0 else brush


def recoloured(
    maps: HairMaps,
    brush: ArrayLike,
    sigma_a: ArrayLike,
    along: tuple[float, float] = (0.0, 1.0),
) -> HairMaps:
    """`maps` with the absorption under the `brush (w, h)` in [0, 1] mixed with `sigma_a (3,)`.

    `along` is the dyed part of the strands, 0 the root and 1 the tip; a layer is dyed by the share
    of its span in this. Maps with fewer cells than the brush are `refined`. Mixed in the square
    root of the absorption, which is perceptually even. Raises `ValueError` for a brush, an
    absorption or a part out of range.
    """
    paint, wanted = np.asarray(brush, float), np.asarray(sigma_a, float)
    if paint.ndim != 2 or not ((paint >= 0) & (paint <= 1)).all():
        raise ValueError(f"the brush must be (w, h) in [0, 1], got shape {paint.shape}")
    if wanted.shape != (3,) or not (wanted >= 0).all():
        raise ValueError(f"sigma_a must be 3 numbers of 0 or more, got {wanted}")
    if not 0 <= along[0] < along[1] <= 1:
        raise ValueError(
            f"along is a part of the strands from a to b with 0 <= a < b <= 1, got {along}"
        )
    fine = refined(maps, (1, *paint.shape))
    layers, *cells = fine.shape
    u, v = (np.arange(n) * m // n for n, m in zip(cells, paint.shape, strict=True))
    share = _covered(along, layers)[:, None, None, None] * paint[np.ix_(u, v)][None, :, :, None]
    root = np.sqrt(fine.sigma_a)
    mixed = (root + share * (np.sqrt(wanted) - root)) ** 2
    return replace(fine, sigma_a=np.where(share > 0, mixed, fine.sigma_a))


def refined(maps: HairMaps, least: tuple[int, int, int]) -> HairMaps:
    """Equivalent `maps` of at least the shape `least`: cells repeated, layers interpolated."""
    layers, columns, rows = maps.shape
    if layers < least[0]:
        between = max(layers - 1, 1)
        layers = 1 + between * -(-(least[0] - 1) // between)
    fine = maps.resized((layers, columns, rows))
    across, down = (max(1, -(-m // n)) for n, m in zip((columns, rows), least[1:], strict=True))
    sigma_a, rotation = (
        x.repeat(across, axis=1).repeat(down, axis=2) for x in (fine.sigma_a, fine.rotation)
    )
    return replace(maps, sigma_a=sigma_a, rotation=rotation)


def roughened(maps: HairMaps, factor: float) -> HairMaps:
    """`maps` with the longitudinal roughness times `factor`; `ValueError` out of (0.001, 1]."""
    return replace(maps, beta_m=factor * maps.beta_m)


def cut(fitted: FittedModel, length: float) -> FittedModel:
    """The model with no strand longer than `length` metres; colours stay where they are on them."""
    if not 0 < length < np.inf:
        raise ValueError(f"strands can be cut to a finite length above 0 m, got {length}")
    strands = fitted.strands
    share = np.minimum(1.0, length / np.maximum(strands.lengths(), 1e-12))
    maps, (w, h) = fitted.maps, fitted.maps.shape[1:]
    if len(maps.sigma_a) > 1:
        cell = _cell_of(fitted.root_uv, (w, h))
        count, total = (np.bincount(cell, x, w * h) for x in (None, share))
        kept = np.divide(total, count, out=np.ones(w * h), where=count > 0).reshape(w, h)
        maps = replace(
            maps,
            sigma_a=_root_part(maps.sigma_a, kept),
            rotation=_root_part(maps.rotation, kept),
        )
    field = None if fitted.field is None else fitted.field.on_cut(share)
    return replace(fitted, strands=strands.cut(length), maps=maps, field=field)


def restyled(fitted: FittedModel, strands: Strands) -> FittedModel:
    """The model with other strands: each takes the place on the scalp of the nearest fitted root.

    Raises `ValueError` where either has no strands.
    """
    if not len(strands) or not len(fitted.strands):
        raise ValueError("restyling needs strands, in the model and in the file")
    _, nearest = cKDTree(fitted.strands.roots).query(strands.roots)
    field = None if fitted.field is None else fitted.field.on_others(nearest)
    return replace(fitted, strands=strands, placed=fitted.root_uv[nearest], field=field)


def _cell_of(root_uv: Array, cells: tuple[int, int]) -> Ints:
    """The cell `(S,)` of each root, v running fastest."""
    column, row = np.minimum((root_uv * cells).astype(int), np.array(cells) - 1).T
    return np.asarray(column * cells[1] + row)


def _covered(along: tuple[float, float], layers: int) -> Array:
    """The share `(layers,)` of each layer's span, half a step to either side, in `along`."""
    middle, half = np.linspace(0, 1, layers), 0.5 / max(layers - 1, 0.5)
    low, high = np.maximum(middle - half, 0), np.minimum(middle + half, 1)
    inside = np.minimum(high, along[1]) - np.maximum(low, along[0])
    return np.maximum(inside, 0) / (high - low)


def _root_part(table: Array, kept: Array) -> Array:
    """The layers of `table (n_c, w, h, k)` over the share `kept (w, h)` of the strands' lengths."""
    layers, columns, rows, _ = table.shape
    at = np.arange(layers)[:, None, None] * kept
    low = np.minimum(at.astype(int), layers - 2)
    u, v = np.ogrid[:columns, :rows]
    share = (at - low)[..., None]
    return np.asarray(table[low, u, v] * (1 - share) + table[low + 1, u, v] * share)

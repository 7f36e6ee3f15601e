"""Edits of fitted maps: colour by wisp, and roughness by `dataclasses.replace`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import gaussian_filter

from appearance.bsdf.maps import HairMaps
from reconstruction.arrays import Array


def wisp_of(strands: ArrayLike, root_uv: Array, cells: tuple[int, int], soft: float = 0.0) -> Array:
    """A brush `(w, h)` in [0, 1]: the share of each cell's strands that are among `strands`.

    `strands` are indices; `root_uv (S, 2)` the places of all roots. `soft` blurs the brush by so
    many cells.
    """
    w, h = cells
    column, row = (np.minimum((root_uv * cells).astype(int), np.array(cells) - 1)).T
    cell = column * h + row
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

    `along` is the part of the strands that is dyed, 0 the root and 1 the tip. Maps with fewer cells
    than the brush get as many. Mixed in the square root of the absorption, in which colours are
    about evenly spaced. Raises `ValueError` for a brush or an absorption out of range.
    """
    paint, wanted = np.asarray(brush, float), np.asarray(sigma_a, float)
    if paint.ndim != 2 or not ((paint >= 0) & (paint <= 1)).all():
        raise ValueError(f"the brush must be (w, h) in [0, 1], got shape {paint.shape}")
    if wanted.shape != (3,) or not (wanted >= 0).all():
        raise ValueError(f"sigma_a must be 3 numbers of 0 or more, got {wanted}")
    layers, columns, rows = maps.shape
    shape = (layers, max(columns, paint.shape[0]), max(rows, paint.shape[1]))
    fine = maps if shape == maps.shape else maps.resized(shape)
    u, v = (
        np.minimum(np.arange(n) * m // n, m - 1)
        for n, m in zip(shape[1:], paint.shape, strict=True)
    )
    at = np.linspace(0, 1, layers) if layers > 1 else np.array([0.5])
    dyed = (at >= along[0]) & (at <= along[1])
    share = dyed[:, None, None, None] * paint[np.ix_(u, v)][None, :, :, None]
    root = np.sqrt(fine.sigma_a)
    mixed = (root + share * (np.sqrt(wanted) - root)) ** 2
    return replace(fine, sigma_a=np.where(share > 0, mixed, fine.sigma_a))

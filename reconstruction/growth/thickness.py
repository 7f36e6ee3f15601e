"""Radii of reconstructed strands, of which there are fewer than hairs."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree
from scipy.stats import trim_mean

from reconstruction.arrays import Array, Floats
from reconstruction.geometry.strands import Strands

HEAD_OF_HAIR = 100_000 * 40e-6
"""Metres of fibre radius on a head: 100,000 fibres of 40 µm (Photobooth §3.4)."""
THINNEST, THICKEST = 4e-5, 4e-4
"""Metres. A fibre's own radius, and that of wisps of 100 fibres."""
NEIGHBOURS = 32
"""Points in the volume that a point's density is measured in: 64 mm of hair at 2 mm spacing."""


def covering_radii(strands: Strands) -> Floats:
    """Radii `(N,)`, metres, with which `strands` cover as much as a head of hair.

    One radius for all, reduced where strands are denser than on average: near the visible surface
    several follow the same measured lines. The volume of a point is the cube of the distance to its
    `NEIGHBOURS`th nearest point, that of an average one the mean of the middle 90 %. Points must be
    evenly spaced along strands.
    """
    each = float(np.clip(HEAD_OF_HAIR / max(len(strands), 1), THINNEST, THICKEST))
    volume = _volumes(strands)
    mean = float(trim_mean(volume, 0.05)) if len(volume) else 0.0
    share = np.minimum(volume / mean, 1) if mean > 0 else np.ones(len(volume))
    return np.maximum(each * share, THINNEST).astype(np.float32)


def _volumes(strands: Strands) -> Array:
    """Volume of each point's neighbourhood `(N,)`, cubic metres up to a constant factor."""
    if len(strands.points) <= NEIGHBOURS:
        return np.ones(len(strands.points))
    tree = cKDTree(strands.points, balanced_tree=False, compact_nodes=False)
    distance, _ = tree.query(strands.points, k=[NEIGHBOURS], workers=-1)
    return np.asarray(distance[:, 0].astype(float) ** 3)

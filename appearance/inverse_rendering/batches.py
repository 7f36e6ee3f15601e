"""Pairs of camera and light that show lit hair."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from appearance.observations import Observed
from reconstruction.arrays import Array, Bools, Ints


@dataclass(frozen=True, eq=False)
class Batch:
    """One view under some lights: `view` and `lights (k,)` are indices."""

    view: int
    lights: Ints


@dataclass(frozen=True, eq=False)
class Patch(Batch):
    """A batch at some of its view's pixels: `few (P,)` are their numbers in the view."""

    few: Ints


@dataclass(frozen=True, eq=False)
class Comparison:
    """A patch `rendered`, `captured` and its local mean `level (k, P, 3)`; `valid (k, P)`."""

    rendered: Array
    captured: Array
    level: Array
    valid: Bools


def lit_pairs(views: Sequence[Observed], scale: float) -> Bools:
    """Which lights light the hair of which view `(V, L)`; `scale` makes radiance exposure units.

    Left out are pairs under whose light the hair is black next to others (under 2 % of the median
    pair), and grazing ones, where under 5 % of the hair pixels are lit: their few rim pixels are
    noise.
    """
    mean, lit = [], []
    for o in views:
        bright = o.radiance.max(axis=-1) * scale * o.valid
        mean.append(bright.mean(axis=1))
        lit.append((bright > 0.02).mean(axis=1))
    level = np.array(mean)
    there = level > 0
    usual = float(np.median(level[there])) if there.any() else 0.0
    return np.asarray(there & (level > 0.02 * usual) & (np.array(lit) > 0.05))

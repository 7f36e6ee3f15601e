"""Which pairs of camera and light a step observes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from appearance.inverse_rendering.losses import weights
from appearance.observations import Observed
from reconstruction.arrays import Array, Bools, Ints

_UNIFORM = 0.5
_FORGET = 0.3


@dataclass(frozen=True, eq=False)
class Batch:
    """One view under some lights: `view` and `lights (k,)` are indices.

    `share (k,)` weighs each pair's loss so that its mean over draws is the mean over all pairs.
    """

    view: int
    lights: Ints
    share: Array


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


class Pairs:
    """The pairs that show lit hair, and how far off each still is.

    Left out are pairs under whose light the hair is black next to others (under 2 % of the median
    pair), and grazing ones, where under 5 % of the hair pixels are lit: their few rim pixels are
    noise. `squared_error (V, L)` is a running estimate, noise taken off.
    """

    def __init__(self, views: Sequence[Observed], scale: float, *, weighted: bool = True) -> None:
        self.weighted = weighted
        mean, lit = [], []
        for o in views:
            bright = o.radiance.max(axis=-1) * scale * o.valid
            mean.append(bright.mean(axis=1))
            lit.append((bright > 0.02).mean(axis=1))
        level = np.array(mean)
        seen = level > 0
        usual = float(np.median(level[seen])) if seen.any() else 0.0
        self.used = seen & (level > 0.02 * usual) & (np.array(lit) > 0.05)
        self.squared_error = np.where(self.used, np.nan, 0.0)

    def draw(self, images: int, rng: np.random.Generator) -> Batch:
        """A view and up to `images` of its lights, by their estimated errors and half at random."""
        chance = self.chance()
        of_view = chance.sum(axis=1)
        view = int(rng.choice(len(of_view), p=of_view / of_view.sum()))
        lights = np.flatnonzero(chance[view] > 0)
        within = chance[view, lights] / of_view[view]
        if len(lights) > images:
            # systematic draw: each light is in with probability images x within, at most 1
            inclusion = _inclusion(within, images)
            order = rng.permutation(len(lights))
            ends = np.cumsum(inclusion[order])
            marks = rng.uniform() + np.arange(images)
            picked = np.unique(order[np.minimum(np.searchsorted(ends, marks), len(order) - 1)])
        else:
            inclusion, picked = np.ones(len(lights)), np.arange(len(lights))
        share = 1.0 / (inclusion[picked] * of_view[view])
        return Batch(view, lights[picked], share / self.used.sum())

    def chance(self) -> Array:
        """Probability of each pair, summing to 1 `(V, L)`."""
        even = self.used / self.used.sum()
        known = self.used & np.isfinite(self.squared_error)
        if not self.weighted or not known.any():
            return even
        # what has not been observed yet is as promising as the best
        score = np.where(
            known, self.squared_error, np.where(self.used, self.squared_error[known].max(), 0.0)
        )
        score = np.sqrt(np.maximum(score, 0))
        if not score.sum() > 0:
            return even
        return np.asarray(_UNIFORM * even + (1 - _UNIFORM) * score / score.sum())

    def update(self, batch: Batch, seen: Comparison) -> None:
        """Update the estimates from a batch, its pixels in the order of the image.

        Neighbouring pixels have independent noise and nearly the same error: the mean product of
        their differences is the squared error without the noise.
        """
        d = (seen.rendered - seen.captured) * np.sqrt(weights(seen.level)) * seen.valid[..., None]
        product = (d[:, 1:] * d[:, :-1]).mean(axis=(1, 2))
        for light, value in zip(batch.lights, product, strict=True):
            old = self.squared_error[batch.view, light]
            new = value if not np.isfinite(old) else old + _FORGET * (value - old)
            self.squared_error[batch.view, light] = new


def _inclusion(within: Array, images: int) -> Array:
    """Probabilities of being among `images` drawn, in proportion to `within`, none above 1."""
    out = np.minimum(images * within / within.sum(), 1.0)
    for _ in range(len(within)):
        free = out < 1
        spare = images - (~free).sum()
        if not free.any() or out[free].sum() <= 0:
            break
        scaled = out[free] * spare / out[free].sum()
        if np.allclose(scaled, out[free]):
            break
        out[free] = np.minimum(scaled, 1.0)
    return out

"""Lamp intensities by variable projection: they are linear, so nothing has to descend to them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from appearance.stage1.batches import Batch, Seen
from appearance.stage1.losses import weights

Array = NDArray[np.float64]
PRIOR = 0.03
"""Standard deviation of a lamp's calibrated intensity, relative."""
_WINDOW = 20.0


class Gains:
    """Factors `(L,)` on the lamps' intensities, solved from what batches show.

    A lamp's factor is Σ w Ī I / Σ w Ī R, R rendered with factor 1, I captured and Ī its local mean:
    least squares with Ī as instrument, so that noise in R, which Σ w R² would count as light, does
    not bias it. Batches are averaged over the latest 20 of a lamp; with the scatter between them as
    error, the prior of 3 % about the calibration draws lamps that say little back to 1. The mean
    factor stays 1: how bright all lamps are together, hair colour cannot be told from.
    """

    def __init__(self, sums: Array) -> None:
        self.sums = sums  # (3, L): weight, log gain, its square; zeros at the start

    @property
    def value(self) -> Array:
        """The factors as they stand."""
        n, total, squares = self.sums
        known = n > 1
        mean = np.divide(total, n, out=np.zeros_like(n), where=n > 0)
        var = np.divide(squares, n, out=np.zeros_like(n), where=n > 0) - mean**2
        pooled = float(np.mean(var[known])) if known.any() else PRIOR**2
        error = (np.maximum(var, 0.25 * pooled) + 1e-8) / np.maximum(n, 1)
        log = np.where(known, mean * PRIOR**2 / (PRIOR**2 + error), 0.0)
        if known.any():
            log[known] -= log[known].mean()
        return np.asarray(np.exp(log))

    def learn(self, batch: Batch, seen: Seen) -> None:
        """Take note of a batch that was rendered with the factors of `value`."""
        gain = self.value[batch.lights]
        instrument = weights(seen.level) * seen.level * seen.valid[..., None]
        top = (instrument * seen.captured).sum(axis=(1, 2))
        below = (instrument * seen.rendered).sum(axis=(1, 2))
        fine = (top > 0) & (below > 0)
        log = np.log(top[fine] / below[fine] * gain[fine])
        lamps = batch.lights[fine]
        self.sums[:, lamps] *= 1 - 1 / _WINDOW
        self.sums[:, lamps] += np.stack([np.ones_like(log), log, log * log])

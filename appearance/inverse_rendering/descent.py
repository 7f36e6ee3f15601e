"""The optimiser: Adam with step sizes for each kind of number, and a test of convergence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from appearance.inverse_rendering.unknowns import Raw
from reconstruction.arrays import Array

STEP = {
    "sigma_a": 0.06,
    "rotation": 0.01,
    "beta_m": 0.06,
    "beta_n": 0.06,
    "eta": 0.03,
    "position": 3e-4,
    "turn": 2e-3,
    "profile": 3e-3,
}
"""In the unconstrained numbers' units; about a fiftieth of what each may be off at the start."""
_OF_CELLS = 0.5
"""A cell learns little from a step, and mostly noise: it moves less."""
_FIRST, _SECOND, _TINY = 0.9, 0.999, 1e-12


@dataclass
class Adam:
    """Adam (Kingma & Ba 2015), whose second moment is at least that of a table's mean cell.

    With each cell's own alone, a cell that hardly any ray meets would walk about at full speed on
    noise; this way it moves in proportion to its gradient, and not at all where that may be noise.
    The second moment forgets slowly: a gradient of path tracing is small most of the time and
    rarely large the other way, and a short memory scales the rare ones down, so that the numbers
    drift where the mean gradient is zero.
    """

    count: int = 0
    first: Raw = field(default_factory=dict)
    second: Raw = field(default_factory=dict)

    def step(self, raw: Raw, gradient: Mapping[str, Array], learning_rate_scale: float) -> None:
        """Move `raw` down the `gradient`, arrays of equal shapes by name, in place."""
        self.count += 1
        for name, g in gradient.items():
            m = self.first.setdefault(name, np.zeros_like(g))
            v = self.second.setdefault(name, np.zeros_like(g))
            m += (1 - _FIRST) * (g - m)
            v += (1 - _SECOND) * (g * g - v)
            ahead = m / (1 - _FIRST**self.count)
            size = v / (1 - _SECOND**self.count)
            step = ahead / np.sqrt(np.maximum(size, size.mean()) + _TINY**2)
            if g.size > 3:
                step *= _OF_CELLS * self._signal_share(ahead, size)
            raw[name] = raw[name] - learning_rate_scale * STEP[name] * step

    def _signal_share(self, ahead: Array, size: Array) -> Array:
        """The share of each cell's mean gradient that is more than noise (James & Stein 1961)."""
        decay = _FIRST**self.count
        noise = size * (1 - _FIRST) / (1 + _FIRST) * (1 - decay**2) / (1 - decay) ** 2
        return np.maximum(1 - noise / np.maximum(ahead**2, _TINY**2), 0)


@dataclass
class Convergence:
    """Halves the learning rate where the validation error no longer falls, some times, then ends.

    The error is that of fixed pairs under fixed random numbers: what changes is the parameters.
    """

    halvings: int = 3
    patience: int = 2
    least_gain: float = 0.01
    learning_rate_scale: float = 1.0
    best: float = float("inf")
    waited: int = 0
    halved: int = 0

    def update(self, error: float) -> bool:
        """Take note of an error; whether the fit has converged."""
        if error < self.best - self.least_gain * abs(self.best) or not np.isfinite(self.best):
            self.best, self.waited = min(error, self.best), 0
            return False
        self.best = min(error, self.best)
        self.waited += 1
        if self.waited > self.patience:
            self.waited, self.halved = 0, self.halved + 1
            self.learning_rate_scale *= 0.5
        return self.halved > self.halvings

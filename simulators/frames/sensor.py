"""What a camera's sensor makes of radiance: counts with noise, 12 bits, saturation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import AnyFloats


@dataclass(frozen=True)
class Sensor:
    """A 12-bit sensor: counts = black + gain · exposure · radiance.

    At the default gain a 20 ms exposure saturates at 4.0 W/(sr m²): hair under one 8 W/sr lamp at
    1.2 m answers 0.1 to 1, its glints more. `electrons_per_count` puts the full well at 10,000
    electrons; `read_noise` is in electrons.
    """

    full_scale: int = 4095
    black: int = 64
    gain: float = 50_000.0
    electrons_per_count: float = 2.48
    read_noise: float = 4.0

    def expose(
        self, radiance: AnyFloats, exposure: float, seed: tuple[int, ...]
    ) -> NDArray[np.uint16]:
        """Counts of `radiance (H, W, 3)`, W/(sr m²), after `exposure` seconds.

        Poisson shot noise and Gaussian read noise in electrons, then rounding and clipping. The
        same `seed` gives the same counts. Raises `ValueError` for NaN.
        """
        if np.isnan(radiance).any():
            where = np.argwhere(np.isnan(radiance))[0].tolist()
            raise ValueError(f"radiance is not a number at (row, column, channel) {where}")
        rng = np.random.default_rng(seed)
        mean = np.asarray(radiance, np.float64) * (exposure * self.gain * self.electrons_per_count)
        # Far beyond saturation the noise does not matter, and Poisson draws have a limit.
        electrons = rng.poisson(np.clip(mean, 0, 1e9)).astype(np.float64)
        electrons += self.read_noise * rng.standard_normal(mean.shape)
        counts = np.rint(electrons / self.electrons_per_count + self.black)
        return np.clip(counts, 0, self.full_scale).astype(np.uint16)

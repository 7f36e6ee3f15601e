"""A view of a fit: what was captured of some pixels beside what inverse rendering makes of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from appearance.fields.grams import Samples
from appearance.fields.hits import Hits
from appearance.fields.options import FieldOptions
from appearance.inverse_rendering import losses
from reconstruction import Light
from reconstruction.arrays import AnyFloats, Bools, Floats


@dataclass(frozen=True, eq=False)
class Pictures:
    """One view of a fit.

    `rendered` (inverse rendering's) and `captured (L, P, 3)` are radiance at the pixels of `hits`
    under each of `lights` alone; `valid (L, P)` is false where a frame is missing or saturated.
    """

    hits: Hits
    lights: tuple[Light, ...]
    rendered: Floats
    captured: Floats
    valid: Bools

    def samples(self, options: FieldOptions, scale: float, unit: float = 1.0) -> Samples:
        """What the fit of a kind of field is about, in exposure units: 1 is white.

        What is added is counted in `unit`s of radiance per irradiance.
        """
        rendered, captured = (x.astype(np.float64) * scale for x in (self.rendered, self.captured))
        level = losses.level(captured)
        if options.kind != "whole":
            level = 0.5 * (level + rendered)
        weight = np.where(self.valid[..., None], losses.weights(np.maximum(level, 0)), 0)
        points = self.hits.middle()
        regressor: AnyFloats = rendered
        if options.kind != "modulation":
            regressor = np.stack([irradiance(x, points) for x in self.lights]) * scale * unit
        target = captured if options.kind == "whole" else captured - rendered
        arrays = (np.asarray(x, np.float32) for x in (regressor, target, weight))
        return Samples(self.lights, points, *arrays)


def irradiance(light: Light, points: Floats) -> Floats:
    """W/m² `(P, 3)` across the light's direction at `points (P, 3)`."""
    squared = np.sum((light.position - points) ** 2, axis=-1, keepdims=True)
    return np.asarray(light.intensity_towards(points) / squared, np.float32)

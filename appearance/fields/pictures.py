"""A view of a fit: captured and rendered images of some pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

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

    `halves (2, L, P, 3)`, two independent renderings, and `captured (L, P, 3)` are radiance at the
    pixels of `hits` under each of `lights` alone; `valid (L, P)` is false where a frame is missing
    or saturated. Products of the halves' errors are unbiased by noise.
    """

    hits: Hits
    lights: tuple[Light, ...]
    halves: Floats
    captured: Floats
    valid: Bools

    def under(self, lights: Sequence[int]) -> Pictures:
        """The same pixels under some of the lights, by their numbers."""
        few = tuple(self.lights[i] for i in lights)
        index = np.asarray(lights, np.int64)
        captured, valid = self.captured[index], self.valid[index]
        return Pictures(self.hits, few, self.halves[:, index], captured, valid)

    def some(self, most: int) -> Pictures:
        """At most `most` of its pixels, evenly spaced."""
        count = len(self.hits.pixels)
        if count <= most:
            return self
        few = np.linspace(0, count - 1, most).astype(np.int64)
        hits = replace(self.hits, pixels=self.hits.pixels[few], table=self.hits.table[few])
        captured, valid = self.captured[:, few], self.valid[:, few]
        return Pictures(hits, self.lights, self.halves[:, :, few], captured, valid)

    def samples(self, options: FieldOptions, scale: float, unit: float = 1.0) -> Samples:
        """The samples of the fit in exposure units (1 is white), an additive field in `unit`s of
        radiance per irradiance."""
        halves, captured = (x.astype(np.float64) * scale for x in (self.halves, self.captured))
        level = losses.level(captured)
        if options.kind != "whole":
            level = 0.5 * (level + halves.mean(axis=0))
        weight = np.where(self.valid[..., None], losses.weights(np.maximum(level, 0)), 0)
        points = self.hits.middle()
        regressors: AnyFloats = halves
        if not options.multiplies:
            given = np.stack([irradiance(x, points) for x in self.lights]) * scale * unit
            regressors = np.broadcast_to(given, halves.shape)
        targets = np.broadcast_to(captured, halves.shape)
        if options.kind != "whole":
            targets = captured - halves
        arrays = (np.asarray(x, np.float32) for x in (regressors, targets, weight))
        return Samples(self.lights, points, *arrays)


def irradiance(light: Light, points: Floats) -> Floats:
    """Irradiance `(P, 3)`, W/m², across the light's direction at `points (P, 3)`."""
    return np.asarray(light.irradiance(points), np.float32)

"""A field of reflectance at single pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance.render.harmonics import harmonics, terms
from appearance.scene.hair_scene import SCALE, HairScene
from reconstruction import Camera, Light
from reconstruction.array_backend import for_kernels
from reconstruction.arrays import AnyFloats, Array, Floats, Ints


@dataclass(frozen=True, eq=False)
class PixelField:
    """Spherical harmonics of the direction to a light in the world, for each of P pixels.

    `coefficients (P, n, 3)`; with a = Y(ω) · coefficients, a light's contribution to a pixel is

    - modulation: the path tracer's times max(0, 1 + a), sample by sample
    - `additive`: the path tracer's plus a times the light's irradiance at the pixel's point;
      without the path tracer's if `alone`

    `points (P, 3)` in metres are the origins of directions to lights. Pixels off the hair have
    coefficients of 0. Coefficients `(P, n, 3 · F)` are those of F fields, by channel; `lit` returns
    all of them.
    """

    coefficients: Floats
    points: Floats
    additive: bool = False
    alone: bool = False

    @property
    def degree(self) -> int:
        """The harmonics' highest degree."""
        return int(np.sqrt(self.coefficients.shape[1])) - 1

    def lit(self, radiance: Floats, lights: Sequence[Light]) -> Floats:
        """`radiance (L, P, 3)` under each of `lights` alone, with the field."""
        fields = self.coefficients.shape[2] // 3
        out = np.repeat(radiance, fields, axis=-1)
        for i, light in enumerate(lights):
            response = self.response(light)
            if not self.additive:
                out[i] *= np.maximum(1 + response, 0)
                continue
            lit = response * np.repeat(self.irradiance(light), fields, axis=-1)
            out[i] = np.maximum(lit if self.alone else out[i] + lit, 0)
        return out

    def response(self, light: Light) -> Floats:
        """a `(P, 3)` under one light."""
        y = harmonics(light.position - self.points, self.degree)
        return np.asarray(np.matmul(y[:, None], self.coefficients)[:, 0])

    def irradiance(self, light: Light) -> Floats:
        """W/m² across the light's direction, at the points `(P, 3)`."""
        return np.asarray(light.irradiance(self.points), np.float32)

    def added(
        self, lights: Sequence[Light], weights: Array, integrals: Sequence[AnyFloats]
    ) -> Floats:
        """What an additive field adds under `lights` times `weights (L, 3)`, and under environments
        whose integrals with the harmonics are `(n, 3)` each: `(P, 3)`."""
        total = np.zeros((len(self.points), 3))
        for light, weight in zip(lights, weights, strict=True):
            total += weight * self.response(light) * self.irradiance(light)
        for each in integrals:
            total += np.einsum("nc,pnc->pc", each, self.coefficients)
        return total.astype(np.float32)

    def mean_factor(self, integrals: AnyFloats) -> Floats:
        """Approximate mean factor on an environment's light: `(P, 3)`, at least 0.1; `integrals
        (n, 3)` are the map's with the harmonics."""
        first = np.maximum(integrals[0], 1e-30)
        mean = integrals / first * harmonics((0, 0, 1.0), 0)
        return np.maximum(1 + np.einsum("nc,pnc->pc", mean, self.coefficients), 0.1)


class DeviceField:
    """A modulation on the device: the factor on a light sample of a pixel."""

    def __init__(self, field: PixelField) -> None:
        # of distant light the direction is the same from all points
        self._count, self._degree = field.coefficients.shape[1], field.degree
        self._coefficients = mi.Float(for_kernels(field.coefficients.ravel()))
        self._points = mi.Float(for_kernels((field.points * SCALE).ravel()))

    def towards(self, slot: Any, direction: Any, active: Any) -> Any:
        """`Color3f` for light from a unit `direction` at the pixel number `slot`."""
        first, total = slot * self._count, mi.Color3f(1)
        for k, y in enumerate(terms(self._degree, direction.x, direction.y, direction.z)):
            total = total + y * dr.gather(mi.Color3f, self._coefficients, first + k, active)
        return dr.maximum(total, 0)

    def at(self, slot: Any, target: Any, active: Any) -> Any:
        """`Color3f` for light from the point `target`, in the scene's units."""
        point = dr.gather(mi.Point3f, self._points, slot, active)
        return self.towards(slot, dr.normalize(target - point), active)


def field_of(scene: HairScene, camera: Camera, pixels: Ints) -> PixelField | None:
    """The field of `scene` at the flat `pixels (P,)`; None where it has none."""
    if scene.field is None or not len(pixels):
        return None
    seen: PixelField = scene.field.at_pixels(scene, camera, pixels)
    return seen


def factor_of(field: PixelField | None) -> DeviceField | None:
    """The factors of a modulation; None for other fields."""
    return None if field is None or field.additive else DeviceField(field)

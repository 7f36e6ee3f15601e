"""Lights from the shading of diffuse spheres by Lambert's law for near lights.

Radiance = albedo / π · I · n·v / |v|³, with v from a point of the sphere to the light: the shading
gives the direction, the fall-off over the sphere the distance, the level the intensity.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from reconstruction.arrays import Array, Bools, Ints
from reconstruction.calibration.boards import CalibrationError
from reconstruction.calibration.least_squares import minimise, numeric
from reconstruction.calibration.solve_lights import LOOSE, CalibratedLight
from reconstruction.geometry.lights import Light

MODEL = 0.01  # relative error of Lambert's law and of pixel means
STEEPEST = 0.15  # least cosine of incidence: grazing light shows the sphere's texture


@dataclass(frozen=True, eq=False)
class Shading:
    """Pixels on diffuse spheres of one radius and albedo under one light alone.

    `eyes` and `rays (N, 3)`, the index of the `sphere (N,)`, `radiance (N, 3)` at full level, and
    its `deviation (N,)` by noise. `centres (S, 3)` with `covariance (3 S, 3 S)`.
    """

    eyes: Array
    rays: Array
    sphere: Ints
    radiance: Array
    deviation: Array
    centres: Array
    covariance: Array
    radius: float
    albedo: float

    @cached_property
    def surface(self) -> tuple[Array, Array]:
        """Points and normals `(N, 3)` where the rays meet the spheres, or pass closest."""
        towards = self.centres[self.sphere] - self.eyes
        along = (self.rays * towards).sum(axis=1)
        inside = along**2 - ((towards * towards).sum(axis=1) - self.radius**2)
        points = self.eyes + (along - np.sqrt(np.maximum(inside, 0)))[:, None] * self.rays
        return points, (points - self.centres[self.sphere]) / self.radius

    @cached_property
    def grey(self) -> Array:
        """Mean over the channels `(N,)`."""
        return np.asarray(self.radiance.mean(axis=1))

    @cached_property
    def error(self) -> Array:
        """Standard deviation of `grey (N,)`, by noise and model error."""
        return np.hypot(self.deviation, MODEL * self.grey)

    def thinned(self, every: int) -> Shading:
        """One in `every` pixels."""
        fields = ("eyes", "rays", "sphere", "radiance", "deviation")
        return replace(self, **{f: getattr(self, f)[::every] for f in fields})

    def form(self, light: Light) -> Array:
        """Radiance `(N,)` under `light` at an intensity of 1."""
        points, normals = self.surface
        v = light.position - points
        strength = replace(light, intensity=np.ones(3)).intensity_towards(points)[:, 0]
        falling = (normals * v).sum(axis=1) / (v * v).sum(axis=1) ** 1.5
        return np.asarray(self.albedo / np.pi * strength * falling)

    def used(self, light: Light) -> Bools:
        """Pixels `(N,)` well lit by `light`."""
        points, normals = self.surface
        v = light.position - points
        cosine = (normals * v).sum(axis=1) / np.linalg.norm(v, axis=1)
        return np.asarray((cosine > STEEPEST) & (self.grey > 6 * self.deviation))


def shaded_light(nominal: Light, shading: Shading) -> CalibratedLight:
    """Position and intensity of a light from diffuse spheres in known places.

    `nominal` gives profile and aim, which are kept, and an initial distance. Raises
    `CalibrationError` if the spheres are not lit or the distance is undetermined.
    """
    lit = shading.grey > 6 * np.maximum(shading.deviation, 1e-12)
    if lit.sum() < 100:
        raise CalibrationError(
            f"light {nominal.name}: it lights {int(lit.sum())} visible pixels of the diffuse "
            "sphere, expected 100 or more: move the sphere or use a longer exposure"
        )
    middle: Array = shading.centres.mean(axis=0)
    away = np.linalg.norm(nominal.position - middle) * _direction(shading, lit)
    start = replace(nominal, position=middle + away, intensity=np.ones(3))
    use = shading.used(start)
    form = shading.form(start)
    if use.sum() < 100 or not (form[use] > 0).all():
        raise CalibrationError(
            f"light {nominal.name}: no camera views the lit side of the diffuse sphere: move the "
            "sphere, or aim a camera at its lit side"
        )
    (x, n), value, error = (a[use] for a in shading.surface), shading.grey[use], shading.error[use]
    v = start.position - x
    # the profile is nearly constant over the sphere and during the solution
    share = form[use] * (v * v).sum(axis=1) ** 1.5 / (n * v).sum(axis=1)

    def function(p: Array) -> tuple[Array, Array]:
        v = p[:3] - x
        squared = (v * v).sum(axis=1)
        nv = (n * v).sum(axis=1)
        strength = share * np.exp(p[3]) / squared**1.5
        model = strength * nv
        gradient = strength[:, None] * (n - (3 * nv / squared)[:, None] * v)
        return (model - value) / error, np.column_stack([gradient, model]) / error[:, None]

    begin = np.log(max(float(form[use] @ value / (form[use] @ form[use])), 1e-12))
    solution = minimise(function, np.append(start.position, begin))
    found = solution.x[:3]
    distance = float(np.linalg.norm(found - middle))
    # an error of a sphere's position rotates all its normals
    worst = float(np.linalg.eigvalsh(shading.covariance)[-1]) / len(shading.centres)
    covariance = solution.covariance[:3, :3] + worst * (distance / shading.radius) ** 2 * np.eye(3)
    light = replace(start, position=found)
    out = CalibratedLight(light, covariance, float(solution.deviation[3]))
    if not out.deviation < LOOSE * distance:
        raise CalibrationError(
            f"light {nominal.name}: its position has a standard deviation of {out.deviation:.3g} m "
            f"at {distance:.3g} m (limit {LOOSE:.0%}): use a larger sphere, or several positions"
        )
    return with_intensity(out, shading)


def with_intensity(known: CalibratedLight, shading: Shading) -> CalibratedLight:
    """`known` with the intensity per channel from its position and the `shading`."""
    use = shading.used(known.light)
    form, weight = shading.form(known.light)[use], shading.error[use] ** -2
    intensity = (form * weight) @ shading.radiance[use] / ((form * weight) @ form)
    return replace(known, light=replace(known.light, intensity=np.maximum(intensity, 0)))


def refine_centres(
    lights: Mapping[str, Light], shadings: Mapping[str, Shading]
) -> dict[str, Shading]:
    """`shadings` with sphere centres refined jointly from shading and outlines.

    Uneven light around an outline biases it by a tenth of a pixel. Each round solves for all lights
    and takes a Gauss-Newton step for the centres with the lights eliminated.
    """
    first = next(iter(shadings.values()))
    prior, centres = np.linalg.inv(first.covariance), first.centres
    for _ in range(3):
        A = prior.copy()
        b = prior @ (centres - first.centres).ravel()
        for name, whole in shadings.items():
            shading = replace(whole, centres=centres).thinned(max(1, len(whole.rays) // 4000))
            try:
                light = shaded_light(lights[name], shading).light
            except CalibrationError:
                continue  # the caller reports it
            r, J = _derivatives(shading, light)
            Q, _ = np.linalg.qr(J[:, :4])
            K = J[:, 4:] - Q @ (Q.T @ J[:, 4:])
            weight = 1 / max(1.0, float(r @ r) / len(r))
            A += weight * K.T @ K
            b += weight * K.T @ r
        centres = centres - np.linalg.solve(A, b).reshape(-1, 3)
    covariance = np.linalg.inv(A)
    return {n: replace(s, centres=centres, covariance=covariance) for n, s in shadings.items()}


def _derivatives(shading: Shading, light: Light) -> tuple[Array, Array]:
    """Residuals `(N,)` and derivatives by the light's position, log intensity, and all centres."""
    use = shading.used(light)
    grey, error = shading.grey[use], shading.error[use]
    strength = float(light.intensity.mean())

    def model(place: Array, centres: Array) -> Array:
        moved = replace(shading, centres=centres)
        return strength * moved.form(replace(light, position=place))[use] / error

    here = np.concatenate([light.position, shading.centres.ravel()])
    now, J = numeric(lambda x: model(x[:3], x[3:].reshape(-1, 3)))(here)
    return now - grey / error, np.column_stack([J[:, :3], now, J[:, 3:]])


def _direction(shading: Shading, lit: Bools) -> Array:
    """Direction `(3,)` to a distant light: radiance = max(n·g, 0)."""
    normals, use, g = shading.surface[1], lit, np.asarray((0.0, 0.0, 1.0))
    for _ in range(4):
        g = np.asarray(np.linalg.lstsq(normals[use], shading.grey[use], rcond=None)[0])
        use = lit & (normals @ g > 0.2 * np.linalg.norm(g))
        if use.sum() < 20:
            break
    return g / max(float(np.linalg.norm(g)), 1e-300)

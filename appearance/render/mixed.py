"""One image under any linear combination of lights and environment maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from appearance.render.coverage import covered_pixels
from appearance.render.environment import CANDIDATES, Sky
from appearance.render.environment_maps import check_environment
from appearance.render.harmonics import projected
from appearance.render.lights import PackedLights
from appearance.render.olat import render_olat
from appearance.render.paths import Surface
from appearance.render.pixel_field import DeviceField, factor_of, field_of
from appearance.render.tracing import (
    SAMPLING,
    PathPlan,
    Paths,
    Sampling,
    add_light,
    follow,
    render_whole,
)
from appearance.scene.hair_scene import HairScene
from appearance.scene.opaque import opaque
from reconstruction import Camera, Light
from reconstruction.array_backend import for_kernels
from reconstruction.arrays import AnyFloats, Array, Floats, Ints

_PILOT = 256  # pixels whose light from each light is estimated first
_SPREAD = 0.1  # share of the choices that all lights have alike
_PILOT_STREAM = 1 << 30


@dataclass(frozen=True, eq=False)
class Environment:
    """A lat-long map `(h, w, 3)` as in `render_environment`, times `weight` (one or 3 numbers)."""

    envmap: AnyFloats
    rotation_deg: float = 0.0
    weight: ArrayLike = 1.0

    def shown(self) -> Floats:
        """The map as it shines `(h, w, 3)`: weighed, and turned by whole columns.

        Raises `ValueError` where that is no map.
        """
        envmap = check_environment(self.envmap, "environment")
        columns = round(envmap.shape[1] * self.rotation_deg / 360)
        weighed = np.roll(envmap, -columns, axis=1) * np.asarray(self.weight, np.float32)
        return check_environment(weighed, "environment times its weight")


def render_mixed(
    scene: HairScene,
    camera: Camera,
    lights: Sequence[Light] = (),
    environments: Sequence[Environment] = (),
    sampling: Sampling = SAMPLING,
    *,
    weights: ArrayLike = 1.0,
) -> Floats:
    """Radiance `(H, W, 3)`, W/(sr m²), of the subject under everything at once.

    `weights` broadcasts to `(L, 3)`: a factor for each light and channel, of any sign (a light may
    be taken away). Every vertex samples one light, in proportion to its mean contribution in a
    pilot pass, and one direction of each environment. Pixels that do not see the subject are 0.
    Raises `ValueError` naming the fault, `FloatingPointError` where light is not finite.
    """
    weight = np.broadcast_to(np.asarray(weights, float), (len(lights), 3))
    of_maps = [np.broadcast_to(np.asarray(e.weight, float), 3) for e in environments]
    if not all(np.isfinite(w).all() for w in (weight, *of_maps)):
        raise ValueError("weights must be finite")
    maps = [check_environment(e.envmap, f"environment {i}") for i, e in enumerate(environments)]
    image = np.zeros((camera.height * camera.width, 3), np.float32)
    index = covered_pixels(scene, camera)
    if not len(index) or not (lights or environments):
        return image.reshape(camera.height, camera.width, 3)
    choice = _choice(scene, camera, lights, weight, index, sampling)

    def render(some: Ints, plan: PathPlan) -> None:
        field = field_of(scene, camera, some)
        gather = _Gather(
            Surface(scene),
            dr.zeros(mi.Float, 3 * len(some)),
            PackedLights.of(lights, weight / choice[:, None]) if lights else None,
            mi.DiscreteDistribution(mi.Float(for_kernels(choice))) if lights else None,
            [
                (Sky.of(m, e.rotation_deg), w)
                for m, e, w in zip(maps, environments, of_maps, strict=True)
            ],
            factor_of(field),
        )
        follow(gather.surface, camera, some, plan, gather)
        radiance = np.array(gather.film).reshape(len(some), 3) / np.float32(plan.spp)
        if field is not None and field.additive:
            integrals = [
                projected(m, e.rotation_deg, field.degree) * w
                for m, e, w in zip(maps, environments, of_maps, strict=True)
            ]
            added = field.added(lights, weight, integrals)
            radiance = np.maximum(added if field.alone else radiance + added, 0)
        image[some] = radiance

    render_whole(camera, index, image, render, sampling.plan())
    return image.reshape(camera.height, camera.width, 3)


def _choice(
    scene: HairScene,
    camera: Camera,
    lights: Sequence[Light],
    weight: Array,
    index: Ints,
    sampling: Sampling,
) -> Array:
    """Probabilities `(L,)` of sampling each light; none is 0, so the estimate is unbiased."""
    if len(lights) < 2:
        return np.ones(len(lights))
    few = index[:: max(1, len(index) // _PILOT)]
    seed, depth = sampling.seed + _PILOT_STREAM, sampling.max_depth
    pilot = render_olat(
        scene, camera, lights, spp=4, max_depth=depth, seed=seed, pixels=few, thrift=0
    )
    share = np.abs(pilot.mean(axis=1) * weight).sum(axis=1)
    uniform = np.full(len(lights), 1 / len(lights))
    total = share.sum()
    return uniform if total == 0 else (1 - _SPREAD) * share / total + _SPREAD * uniform


@dataclass(frozen=True)
class _Gather:
    """Light of one light and of one direction of each sky at a path's vertex."""

    surface: Surface
    film: Any
    bank: PackedLights | None
    choice: Any
    skies: Sequence[tuple[Sky, Array]]
    factor: DeviceField | None

    def __call__(self, si: Any, paths: Paths) -> None:
        rng, active = paths.rng, paths.active
        surface = self.surface.towards(si, active)
        if self.bank is not None:
            light = self.choice.sample(rng.next_float32(), active)
            # the bank's intensities are divided by the probability of the choice
            target, intensity = self.bank.sample(light, si.p, rng, active)
            towards = target - si.p
            squared = dr.squared_norm(towards)
            wo = si.to_local(towards * dr.rsqrt(squared))
            value = paths.throughput * surface(wo, active) * (intensity / squared)
            if self.factor is not None:
                value = value * self.factor.at(paths.slot, target, active)
            self._add(value, si.spawn_ray_to(target), paths)
        for sky, weight in self.skies:
            direction, value = sky.resampled(si, surface, rng, active, CANDIDATES)
            value = paths.throughput * value * mi.Color3f(*opaque(weight))
            if self.factor is not None:
                value = value * self.factor.towards(paths.slot, direction, active)
            self._add(value, si.spawn_ray(direction), paths)

    def _add(self, value: Any, ray: Any, paths: Paths) -> None:
        lit = paths.active & (dr.max(dr.abs(value)) > 0)
        lit &= ~self.surface.scene.occluded(ray, lit)
        add_light(self.film, value, paths.slot * 3, lit)

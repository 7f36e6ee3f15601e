"""Radiance under each light, differentiable in the hair, the skin and the lights: path replay.

The gradient takes two walks along the same camera paths, from the same seeds (Vicini et al. 2021).
The first sums what each path brings in, weighted by the gradient of the loss; the second subtracts
vertex after vertex from that sum: what is left is the light that arrives from further along, and
the path needs no memory. Directions, roulette and geometry are held fixed. What a moving shadow
edge does is left out: a light's gradient is that of the light that arrives where it does already.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from appearance.render.lights import PackedLights
from appearance.render.paths import Surface, Wave, continue_path, each_sample, pixel_indices
from appearance.scene.hair_appearance import DiffuseHair
from appearance.scene.hair_scene import SCALE, HairScene
from appearance.scene.opaque import opaque_index
from reconstruction import Camera, Light
from reconstruction.array_backend import for_kernels
from reconstruction.options import Count, options

_GRADIENT_STREAM = 1 << 29
_UNITS = {"lights.position": SCALE, "lights.intensity": SCALE**2, "lights.turn": 1.0}


@options
class ReplaySampling:
    """`spp` paths a pixel of at most `max_depth` vertices, with roulette from vertex `rr_depth`."""

    spp: Count = 32
    max_depth: Count = 8
    rr_depth: int = 4


SAMPLING = ReplaySampling()


class DifferentiableOlat:
    """The pixels `(P,)` of `camera` under each of `lights` alone, as a function of parameters.

    The paths of `sampling` serve all lights. The BSDF of `scene` holds the parameters' values
    during a call only.

    With a `guide`, the same geometry with materials of its own (`scene.with_hair(…)`), directions
    are drawn from those, and the paths are the same for all values of the parameters: but for
    roulette and shadow edges, the radiance of one seed is then a smooth function of them, with more
    noise the further they are from the guide.
    """

    def __init__(
        self,
        scene: HairScene,
        camera: Camera,
        lights: Sequence[Light],
        pixels: ArrayLike,
        sampling: ReplaySampling = SAMPLING,
        guide: HairScene | None = None,
    ) -> None:
        if not lights:
            raise ValueError("lights must not be empty")
        if guide is not None and guide.hair_bsdf is scene.hair_bsdf is not None:
            raise ValueError("the guide must have a hair BSDF of its own: see HairScene.with_hair")
        self.scene, self.camera, self.lights = scene, camera, tuple(lights)
        self.guide = guide
        self.index = pixel_indices(camera, pixels)
        self.sampling = sampling
        self._bank = PackedLights.of(self.lights)

    def parameters(self) -> dict[str, Any]:
        """Copies of the values that scene and lights have, by name, for `dr.enable_grad`.

        `hair.…`: what `mitsuba.traverse` finds in the hair's BSDF, or `hair.albedo` of diffuse
        fibres; `skin`: the head's albedo, `Color3f`. `lights.position (L, 3)` in metres,
        `lights.intensity (L, 3)` in W/sr, `lights.turn (L, 3)`: by how many radians each light is
        turned about its centre, an axis-angle in the world's frame, 0 now (no effect on lights
        without an orientation).
        """
        values: dict[str, Any] = {
            "skin": mi.Color3f(*self.scene.skin),
            "lights.position": mi.TensorXf(for_kernels([x.position for x in self.lights])),
            "lights.intensity": mi.TensorXf(for_kernels([x.intensity for x in self.lights])),
            "lights.turn": dr.zeros(mi.TensorXf, (len(self.lights), 3)),
        }
        if isinstance(self.scene.hair, DiffuseHair):
            values["hair.albedo"] = mi.Color3f(*self.scene.hair.albedo)
        for name, value in self._hair():
            if dr.is_diff_v(value) and dr.is_float_v(value):
                values[f"hair.{name}"] = type(value)(dr.detach(value))
        return values

    def radiance(
        self, parameters: Mapping[str, Any], *, seed: int = 0, gradient_seed: int | None = None
    ) -> Any:
        """`mitsuba.TensorXf (L, P, 3)`, W/(sr m²), with derivatives in backward mode.

        Parameters that are left out keep their values. The gradient's paths are drawn from
        `gradient_seed`, by default independent of the picture's: a loss that is not linear would
        otherwise see its own noise. Same seeds, same picture to the byte; gradients are summed in
        no fixed order and repeat to rounding. Raises `ValueError` for unknown names.
        """
        values = self.parameters()
        if unknown := set(parameters) - set(values):
            raise ValueError(f"unknown parameters {sorted(unknown)}; known are {sorted(values)}")
        values |= parameters
        wanted = [k for k, v in values.items() if dr.grad_enabled(v)]
        again = seed + _GRADIENT_STREAM if gradient_seed is None else gradient_seed
        return dr.custom(_operation(), self, values, tuple(wanted), seed, again)

    def _hair(self) -> Any:
        """The parameters of the hair's BSDF, as Mitsuba finds them."""
        return mi.traverse(self.scene.hair_bsdf) if self.scene.hair_bsdf is not None else {}

    @contextmanager
    def _applied(self, values: Mapping[str, Any]) -> Iterator[tuple[Surface, PackedLights]]:
        """Surface and lights with these values, in scene units; the BSDF gets its own back."""
        before = self.parameters()
        self._set_hair(values)
        bank = replace(
            self._bank,
            positions=values["lights.position"].array,
            intensities=values["lights.intensity"].array,
            turns=None if self._bank.orientations is None else values["lights.turn"].array,
        )
        guide = None if self.guide is None else Surface(self.guide)
        try:
            yield _Painted(self.scene, values["skin"], values.get("hair.albedo"), guide), bank
        finally:
            self._set_hair(before)

    def _set_hair(self, values: Mapping[str, Any]) -> None:
        found = self._hair()
        for name, _ in found:
            if f"hair.{name}" in values:
                found[name] = values[f"hair.{name}"]
        if found:
            found.update()

    def picture(self, values: Mapping[str, Any], seed: int) -> Any:
        """The radiance for detached `values`."""
        film = dr.zeros(mi.Float, 3 * len(self.lights) * len(self.index))
        with self._applied(_scaled(values)) as (surface, bank):

            def trace(paths: Wave) -> None:
                walk = _Walk(self, surface, bank, paths, film, None)
                walk.along(mi.Color3f(0), paths.rng)

            self._each_sample(seed, trace)
        return mi.TensorXf(film / self.sampling.spp, (len(self.lights), len(self.index), 3))

    def gradients(
        self, values: Mapping[str, Any], wanted: Sequence[str], weight: Any, seed: int
    ) -> dict[str, Any]:
        """Derivatives of the sum of `weight (L, P, 3)` times the radiance, for the `wanted`."""
        leaves = _scaled(values)
        for name in wanted:
            dr.enable_grad(leaves[name])
        share = mi.Float(weight.array) / self.sampling.spp
        dr.make_opaque(share)
        generator: Any = mi.PCG32
        suspend: Any = dr.suspend_grad  # untyped
        with self._applied(leaves) as (surface, bank), suspend():

            def trace(paths: Wave) -> None:
                again = generator(paths.rng)
                walk = _Walk(self, surface, bank, paths, None, share)
                total = walk.along(mi.Color3f(0), paths.rng)
                replace(walk, replay=True).along(total, again)

            self._each_sample(seed, trace)
            dr.eval()
        return {k: dr.grad(leaves[k]) * _UNITS.get(k, 1.0) for k in wanted}

    def _each_sample(self, seed: int, trace: Any) -> None:
        index = mi.UInt32(for_kernels(self.index, np.uint32))
        each_sample(self.camera, index, len(self.index), self.sampling.spp, seed, trace)


def _operation() -> Any:
    """The custom operation of Dr.Jit that ties the picture to its gradients."""

    class Radiance(dr.CustomOp):
        def eval(
            self,
            owner: DifferentiableOlat,
            values: dict[str, Any],
            wanted: tuple[str, ...],
            seed: int,
            again: int,
        ) -> Any:
            self.owner, self.values, self.wanted, self.again = owner, values, wanted, again
            return owner.picture(values, seed)

        def backward(self) -> None:
            found = self.owner.gradients(self.values, self.wanted, self.grad_out(), self.again)
            zero = {k: dr.zeros(type(v), dr.shape(v)) for k, v in self.values.items()}
            self.set_grad_in("values", {**zero, **found})

        def name(self) -> str:
            return "differentiable OLAT"

    return Radiance


def _scaled(values: Mapping[str, Any]) -> dict[str, Any]:
    """Copies of `values` in scene units, read from memory by kernels."""
    out = {}
    for name, value in values.items():
        out[name] = type(value)(dr.detach(value)) * _UNITS.get(name, 1.0)
        dr.make_opaque(out[name])
    return out


@dataclass(frozen=True)
class _Painted(Surface):
    """Surfaces whose diffuse albedos may be differentiated, and whose samples may be guided."""

    skin: Any
    fibres: Any | None
    guide: Surface | None

    def sample(self, si: Any, u1: Any, u2: Any, active: Any) -> tuple[Any, Any]:
        """A local direction, of the guide where there is one, and its weight."""
        if self.guide is None:
            return super().sample(si, u1, u2, active)
        wo, weight = self.guide.sample(si, u1, u2, active)
        drawn = self.guide.eval(si, wo, active)
        possible = drawn > 0
        here = weight * self.eval(si, wo, active) / dr.select(possible, drawn, 1)
        return wo, dr.select(possible, here, 0)

    def _diffuse(self, hair: Any) -> Any:
        return self.skin if self.fibres is None else dr.select(hair, self.fibres, self.skin)


@dataclass(frozen=True)
class _Walk:
    """One walk along a wave of paths.

    With a `film`, light is added to it. With `share (3 L P,)`, weights of the film's entries, the
    walk sums the weighted light; on `replay` it takes it off the sum again, and differentiates.
    """

    owner: DifferentiableOlat
    surface: Surface
    bank: PackedLights
    paths: Wave
    film: Any | None
    share: Any | None
    replay: bool = False

    def along(self, total: Any, rng: Any) -> Any:
        """Walk all paths, starting from the sum `total`; returns the sum."""
        si = self.surface.interact(self.paths.rays, mi.Bool(True))
        max_depth = self.owner.sampling.max_depth

        def more(si: Any, beta: Any, total: Any, depth: Any, rng: Any, active: Any) -> Any:
            return active

        def body(si: Any, beta: Any, total: Any, depth: Any, rng: Any, active: Any) -> Any:
            total = self._lights(si, beta, total, rng, active)
            active = active & (depth + 1 < max_depth)
            roulette = depth + 1 >= self.owner.sampling.rr_depth
            ray, beta, active = continue_path(self.surface, si, beta, rng, roulette, active)
            if self.replay:
                self._bounce(si, ray, total, active)
            si = self.surface.interact(ray, active)
            return si, beta, total, depth + 1, rng, active & si.is_valid()

        state = (si, mi.Color3f(1), total, mi.UInt32(0), rng, si.is_valid())
        return dr.while_loop(state, more, body, label="path")[2]

    def _lights(self, si: Any, beta: Any, total: Any, rng: Any, active: Any) -> Any:
        """The light of all lights at a vertex."""
        count, slots = opaque_index(self.bank.count), opaque_index(len(self.owner.index))
        resume: Any = dr.resume_grad  # untyped

        def more(light: Any, total: Any, rng: Any) -> Any:
            return light < count

        def body(light: Any, total: Any, rng: Any) -> Any:
            with resume(when=self.replay):
                target, intensity = self.bank.sample(light, si.p, rng, active)
                towards = target - si.p
                squared = dr.squared_norm(towards)
                wo = si.to_local(towards * dr.rsqrt(squared))
                value = beta * self.surface.eval(si, wo, active) * (intensity / squared)
            lit = active & (dr.max(dr.detach(value)) > 0)
            ray = si.spawn_ray_to(dr.detach(target))
            lit &= ~self.surface.scene.occluded(ray, lit)
            put = (light * slots + self.paths.slot) * 3
            if self.film is not None:
                for channel in range(3):
                    dr.scatter_add(self.film, value[channel], put + channel, lit)
            else:
                share = mi.Color3f(
                    [dr.gather(mi.Float, self.share, put + c, lit) for c in range(3)]
                )
                with resume(when=self.replay):
                    arrives = dr.select(lit, share * value, 0)
                    if dr.grad_enabled(arrives):
                        dr.backward_from(arrives)
                arrives = dr.detach(arrives)
                total = total - arrives if self.replay else total + arrives
            return light + 1, total, rng

        return dr.while_loop((mi.UInt32(0), total, rng), more, body, label="lights of a vertex")[1]

    def _bounce(self, si: Any, ray: Any, total: Any, active: Any) -> None:
        """What is still to come was multiplied by the BSDF at this vertex."""
        resume: Any = dr.resume_grad  # untyped
        with resume():
            value = self.surface.eval(si, si.to_local(ray.d), active)
            if dr.grad_enabled(value):
                here = dr.detach(value)
                passed = active & (here > 0)
                dr.backward_from(dr.select(passed, total * value / dr.select(passed, here, 1), 0))

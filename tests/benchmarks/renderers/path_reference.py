"""The readable reference for `render_olat`: Mitsuba's own `path` integrator, light by light."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance import HairScene
from appearance.render.paths import wave
from appearance.scene.hair_appearance import DiffuseHair
from appearance.scene.hair_scene import light_arrays
from reconstruction import Camera, Light
from reconstruction.array_backend import for_kernels
from reconstruction.arrays import Floats, Ints

_LANES = 1 << 20


class PathReference:
    """A scene's geometry under one Mitsuba point light that moves from light to light.

    Built once for many lights, so that its time against `render_olat`'s is spent on paths only.
    """

    def __init__(self, scene: HairScene, max_depth: int, rr_depth: int = 4) -> None:
        light = {"type": "point", "position": [0, 0, 0], "intensity": {"type": "rgb", "value": 1}}
        self._scene = mi.load_dict({"type": "scene", **material_shapes(scene), "light": light})
        self._parameters = mi.traverse(self._scene)
        # Mitsuba counts segments: its depth 2 is our one vertex.
        self._integrator = mi.load_dict(
            {"type": "path", "max_depth": max_depth + 1, "rr_depth": rr_depth + 1}
        )

    def render(
        self,
        camera: Camera,
        lights: Sequence[Light],
        pixels: Ints,
        *,
        spp: int,
        seed: int = 0,
    ) -> Floats:
        """Radiance `(L, P, 3)` of the flat `pixels (P,)` under each light alone, W/(sr m²).

        Raises `ValueError` for lights that are not isotropic points.
        """
        if shaped := [x.name for x in lights if x.radius or x.size or x.profile]:
            raise ValueError(f"the reference knows point lights only, and {shaped} are none")
        out = np.empty((len(lights), len(pixels), 3), np.float32)
        positions, intensities = light_arrays(lights)
        for i in range(len(lights)):
            self._move(positions[i], intensities[i])
            out[i] = self._light(camera, pixels, spp, (seed, i))
        return out

    def _move(self, position: Floats, intensity: Floats) -> None:
        self._parameters["light.position"] = mi.Point3f(*(float(p) for p in position))
        self._parameters["light.intensity.value"] = mi.Color3f(*(float(c) for c in intensity))
        self._parameters.update()

    def _light(self, camera: Camera, pixels: Ints, spp: int, seed: tuple[int, int]) -> Floats:
        index = mi.UInt32(for_kernels(pixels, np.uint32))
        film = dr.zeros(mi.Float, 3 * len(pixels))
        for first, count in _passes(spp, max(1, _LANES // len(pixels))):
            paths = wave(camera, index, len(pixels), first, count, spp, *seed)
            sampler: Any = mi.load_dict({"type": "independent"})
            state = np.random.SeedSequence([*seed, first]).generate_state(1)[0]
            sampler.seed(dr.opaque(mi.UInt32, int(state)), count * len(pixels))
            value = self._integrator.sample(self._scene, sampler, mi.RayDifferential3f(paths.rays))[
                0
            ]
            for channel in range(3):
                dr.scatter_add(film, value[channel], paths.slot * 3 + channel)
            dr.eval(film)
        image = np.array(film, dtype=np.float32).reshape(len(pixels), 3)
        return np.asarray(image / np.float32(spp), dtype=np.float32)


def material_shapes(scene: HairScene) -> dict[str, Any]:
    """The shapes of `scene` with their materials attached, as Mitsuba's own integrators expect.

    They are shared with the scene and keep the materials of the latest call. The head gets a
    two-sided `diffuse`.
    """
    shapes: dict[str, Any] = {}
    if scene.hair_shape is not None:
        bsdf = scene.hair_bsdf
        if isinstance(scene.hair, DiffuseHair):
            bsdf = mi.load_dict(_diffuse(scene.hair.albedo))
        scene.hair_shape.set_bsdf(bsdf)
        shapes["hair"] = scene.hair_shape
    if scene.head_shape is not None:
        skin = {"type": "twosided", "material": _diffuse(scene.skin)}
        scene.head_shape.set_bsdf(mi.load_dict(skin))
        shapes["head"] = scene.head_shape
    return shapes


def _diffuse(albedo: tuple[float, float, float]) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": list(albedo)}}


def _passes(spp: int, most: int) -> Iterator[tuple[int, int]]:
    """(first sample, count) of the passes that make up `spp` samples, `most` at most each."""
    for first in range(0, spp, most):
        yield first, min(most, spp - first)

"""Benchmark of a sweep of scanlines in one pass beside line by line."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance import HairScene, render_scanlines
from appearance.render.bounces import bounce_limit
from appearance.render.paths import wave
from appearance.scene.hair_scene import SCALE
from benchmarks.renderers.path_reference import material_shapes
from reconstruction import Camera, Projector
from reconstruction.array_backend import for_kernels
from reconstruction.arrays import Floats, Ints

_FINE = 2  # texels of Mitsuba's projector per row


def measure_scanlines(
    scene: HairScene,
    camera: Camera,
    projector: Projector,
    index: Ints,
    *,
    lines: int = 6,
    spp: int = 256,
    seed: int = 0,
) -> dict[str, Any]:
    """Time and noise of a whole sweep, beside `lines` lines one by one, scaled to all.

    One by one with ours (`rows` of one line) and with Mitsuba's `path` under its `projector` that
    shows a picture of one line. Noise is the variance over the squared mean square of the same
    lines, from two seeds. `gain` is the ratio of variance x CPU time.
    """
    depth = bounce_limit(scene, camera, pixels=index, seed=seed).depth
    middle = np.linspace(0.35, 0.65, lines) * projector.height
    rows = [int(row) for row in middle]

    def sweep(seed: int) -> Floats:
        films = render_scanlines(
            scene, camera, [projector], spp=spp, max_depth=depth, seed=seed, pixels=index
        )
        return films[projector.name][rows]

    def one_by_one(seed: int) -> Floats:
        return np.concatenate(
            [
                render_scanlines(
                    scene,
                    camera,
                    [projector],
                    spp=spp,
                    max_depth=depth,
                    seed=seed,
                    pixels=index,
                    rows={projector.name: range(row, row + 1)},
                )[projector.name]
                for row in rows
            ]
        )

    theirs = _Lines(scene, projector, depth)

    def path(seed: int) -> Floats:
        return np.array([theirs.render(camera, index, row, spp, seed) for row in rows])

    whole = projector.height / lines
    found: dict[str, Any] = {"rows": projector.height, "lines": lines, "spp": spp, "depth": depth}
    found["sweep"] = _measure(sweep, 1.0, seed)
    found["one by one"] = _measure(one_by_one, whole, seed)
    found["mitsuba path"] = _measure(path, whole, seed)
    for name in ("one by one", "mitsuba path"):
        ratio = [found[name][k] / found["sweep"][k] for k in ("variance", "cpu_seconds")]
        found[name]["gain"] = ratio[0] * ratio[1]
    return found


def _measure(render: Callable[[int], Floats], scale: float, seed: int) -> dict[str, float]:
    render(seed)
    start = time.process_time()
    a = render(seed + 1).astype(float)
    seconds = (time.process_time() - start) * scale
    b = render(seed + 2).astype(float)
    variance = ((a - b) ** 2).mean() / 2
    power = ((a + b) ** 2).mean() / 4 - variance / 2
    return {"cpu_seconds": seconds, "variance": float(variance / power)}


class _Lines:
    """The scene under Mitsuba's `projector`, which shows one row at a time."""

    def __init__(self, scene: HairScene, projector: Projector, depth: int) -> None:
        self._rows = projector
        to_world = np.eye(4)
        # Mitsuba's cameras and projectors look along +z with x to the left and y up
        to_world[:3, :3] = projector.R.T @ np.diag([-1.0, -1.0, 1.0])
        to_world[:3, 3] = projector.center * SCALE
        fov = 2 * np.degrees(np.arctan(projector.width / 2 / projector.K[0, 0]))
        lamp = {
            "type": "projector",
            "to_world": mi.ScalarTransform4f(to_world.tolist()),
            "fov": fov,
            "fov_axis": "x",
            "irradiance": {
                "type": "bitmap",
                "filter_type": "nearest",
                "raw": True,
                "bitmap": mi.Bitmap(self._picture(0)),
            },
        }
        self._scene = mi.load_dict({"type": "scene", **material_shapes(scene), "lamp": lamp})
        self._parameters = mi.traverse(self._scene)
        self._integrator = mi.load_dict({"type": "path", "max_depth": depth + 1, "rr_depth": 5})

    def _picture(self, row: int) -> Floats:
        p = self._rows
        v = (np.arange(p.height * _FINE) + 0.5) / _FINE - 0.5
        weight = p.row_weight(row, v).astype(np.float32)
        return np.broadcast_to(weight[:, None, None], (len(v), p.width * _FINE, 3)).copy()

    def render(self, camera: Camera, index: Ints, row: int, spp: int, seed: int) -> Floats:
        """Radiance `(P, 3)` under one row, in the emitter's own unit."""
        self._parameters["lamp.irradiance.data"] = mi.TensorXf(for_kernels(self._picture(row)))
        self._parameters.update()
        pixels = mi.UInt32(for_kernels(index, np.uint32))
        paths = wave(camera, pixels, len(index), 0, spp, spp, seed, row)
        sampler: Any = mi.load_dict({"type": "independent"})
        sampler.seed(dr.opaque(mi.UInt32, seed * 8191 + row), spp * len(index))
        rays = mi.RayDifferential3f(paths.rays)
        value = self._integrator.sample(self._scene, sampler, rays)[0]
        film = dr.zeros(mi.Float, 3 * len(index))
        for channel in range(3):
            dr.scatter_add(film, value[channel], paths.slot * 3 + channel)
        return np.array(film, np.float32).reshape(len(index), 3) / np.float32(spp)

"""Gradients by path replay beside finite differences, and what they cost.

`python -m benchmarks.renderers.gradients OUT` writes `gradients.json` and `gradients.png`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from appearance import DifferentiableOlat, HairAppearance, HairScene, build_scene
from appearance.render.differentiable import ReplaySampling
from appearance.scene.backend import ensure_backend
from benchmarks.command import Benchmark
from benchmarks.results import Panel, draw_panels, save
from reconstruction import Camera, Light, Mesh, Progress, Strands
from reconstruction.arrays import Array

STEP = 0.01
"""Metres that the light is moved by, either way, for a finite difference."""
HAIR = HairAppearance((0.06, 0.1, 0.2), 0.3, 0.3)
SUBJECTS = ("bare floor", "floor under a wall's edge", "tuft of hair on the floor")


def subject(name: str) -> HairScene:
    """One of `SUBJECTS`."""
    floor = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 0.6
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    strands = Strands.from_list([])
    if name == SUBJECTS[1]:
        wall = np.array([[0, -2, 0.25], [2, -2, 0.25], [2, 2, 0.25], [0, 2, 0.25]])
        floor, faces = np.concatenate([floor, wall]), np.concatenate([faces, faces + 4])
    if name == SUBJECTS[2]:
        strands = _tuft(200)
    return build_scene(strands, Mesh(floor, faces), hair=HAIR, skin=(0.5, 0.5, 0.5))


def _tuft(count: int) -> Strands:
    rng = np.random.default_rng(0)
    angle, radius = rng.uniform(0, 2 * np.pi, count), 0.02 * np.sqrt(rng.uniform(size=count))
    root = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(count)], -1)
    t = np.linspace(0, 1, 8)[:, None]
    bend = rng.normal(scale=0.008, size=(count, 1, 3)) * t**2
    return Strands.from_list(list(root[:, None] + bend + 0.06 * t * [0, 0, 1]), radius=4e-4)


def _camera() -> Camera:
    return Camera.look_at("c", 24, 24, (-0.12, -0.02, 0.2), (0, 0, 0.01), 22)


def _light(x: float) -> Light:
    return Light("l", np.array([x, 0.0, 1.0]), np.full(3, 8.0))


def moved_light(scene: HairScene, places: Array, spp: int, runs: int) -> dict[str, list[float]]:
    """Derivatives of the picture's mean by the light's x at `places (N,)`, in two ways.

    Means and standard errors over `runs` seeds; both sides of a difference share their seed.
    """
    camera = _camera()
    pixels = np.arange(camera.width * camera.height)
    found: dict[str, list[float]] = {k: [] for k in _CURVES}
    for x in places:
        ops = {
            d: DifferentiableOlat(scene, camera, [_light(x + d)], pixels, ReplaySampling(spp, 4))
            for d in (-STEP, 0.0, STEP)
        }
        replayed, difference = [], []
        for seed in range(runs):
            values = ops[0.0].parameters()
            dr.enable_grad(values["lights.position"])
            dr.backward(dr.mean(ops[0.0].radiance(values, gradient_seed=seed)))
            replayed.append(float(np.array(dr.grad(values["lights.position"]))[0, 0]))
            mean = {
                d: float(np.array(op.radiance({}, seed=seed), float).mean())
                for d, op in ops.items()
            }
            difference.append((mean[STEP] - mean[-STEP]) / (2 * STEP))
        for name, numbers in zip(_CURVES[::2], (replayed, difference), strict=True):
            found[name].append(float(np.mean(numbers)))
            found[f"{name} error"].append(float(np.std(numbers, ddof=1) / np.sqrt(runs)))
    return found


_CURVES = ("replayed", "replayed error", "difference", "difference error")


def cost(depths: tuple[int, ...], spp: int) -> list[dict[str, float]]:
    """Seconds and bytes of a picture and of all its gradients, by the limit of bounces."""
    scene, camera = subject(SUBJECTS[2]), _camera()
    rows = []
    lights = [replace(_light(x), name=str(x)) for x in (-0.3, 0.0, 0.3)]
    for depth in depths:
        op = DifferentiableOlat(
            scene, camera, lights, np.arange(576), ReplaySampling(spp, depth, depth)
        )

        def picture(op: DifferentiableOlat = op) -> None:
            dr.eval(op.radiance({}, seed=1))

        def gradient(op: DifferentiableOlat = op) -> None:
            values = op.parameters()
            for value in values.values():
                dr.enable_grad(value)
            dr.backward(dr.mean(op.radiance(values, seed=1, gradient_seed=1)))
            dr.eval(*(dr.grad(v) for v in values.values()))

        rows.append(
            {
                "max_depth": depth,
                **{f"picture {k}": v for k, v in _measured(picture).items()},
                **{f"gradient {k}": v for k, v in _measured(gradient).items()},
            }
        )
    return rows


def _measured(work: Callable[[], None]) -> dict[str, float]:
    """Seconds and most bytes held, the second time: kernels are compiled by then."""
    work()
    dr.sync_thread()
    detail: Any = dr.detail
    detail.malloc_clear_statistics()
    start = time.perf_counter()
    work()
    dr.sync_thread()
    seconds = time.perf_counter() - start
    return {"seconds": seconds, "bytes": float(detail.malloc_watermark(dr.JitBackend.LLVM))}


def run(
    out: Path, *, spp: int = 1024, runs: int = 4, depths: tuple[int, ...] = (2, 4, 8, 16, 32)
) -> dict[str, Any]:
    """Measure, write `gradients.json` and `gradients.png` into `out`, return the former."""
    ensure_backend()
    places = np.linspace(-0.2, 0.2, 9 if runs > 2 else 2)
    result: dict[str, Any] = {"light_x": places.tolist(), "subjects": {}, "seeds": runs}
    for name in SUBJECTS:
        result["subjects"][name] = moved_light(subject(name), places, spp, runs)
        save(out / "gradients.json", result)
    result["cost"] = cost(depths, spp // 4)
    save(out / "gradients.json", result)
    labels = {"difference": "finite difference", "replayed": "path replay"}
    draw_panels(
        out / "gradients.png",
        [
            [
                Panel(
                    name,
                    {
                        label: list(zip(places, found[k], found[f"{k} error"], strict=True))
                        for k, label in labels.items()
                    },
                    "the light's x (m)",
                    "d mean radiance / dx",
                    ("linear", "linear"),
                    {"finite difference": "o", "path replay": "-"},
                )
                for name, found in result["subjects"].items()
            ]
        ],
    )
    return result


def _bench(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    progress("gradients", 0.0)
    if args.quick:
        return run(args.out, spp=16, runs=2, depths=(2, 4))
    return run(args.out)


BENCHMARK = Benchmark(_bench)

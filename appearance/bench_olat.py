"""Benchmark: error against run time of `render_olat` and of Mitsuba's `path` light by light."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appearance.hair_appearance import HairAppearance
from appearance.render.coverage import covered_pixels
from appearance.render.olat import render_olat
from appearance.render.reference import PathReference
from appearance.scene import build_scene
from reconstruction.cameras import Camera
from reconstruction.lights import Light
from reconstruction.mesh import Mesh
from reconstruction.strands import Strands

Image = NDArray[np.float32]


def run(
    out: Path,
    *,
    strands: Strands,
    head: Mesh | None,
    hair: HairAppearance,
    camera: Camera,
    lights: Sequence[Light],
    skin: tuple[float, float, float] = (0.35, 0.25, 0.2),
    pixels: int = 1500,
    spp: Sequence[int] = (2, 4, 8, 16, 32),
    path_spp: Sequence[int] = (2, 4, 8, 16),
    reference_spp: int = 256,
    max_depth: int = 16,
    seed: int = 0,
) -> dict[str, Any]:
    """Measure both renderers on the same scene and pixels; write `olat.json` and `olat.png`.

    The error is the mean squared error over the mean square of the reference, averaged over lights
    and channels. The reference is our renderer at `reference_spp` (the tests show that both agree
    in the mean); its own variance, from its two halves, is subtracted. Kernels are compiled
    before the clock starts. `gain` is how much longer `path` takes to the same error: the ratio of
    error x seconds at both largest sample counts. Returns what `olat.json` holds.
    """
    if not lights:
        raise ValueError("the OLAT benchmark needs at least one light")
    scene = build_scene(strands, head, hair=hair, skin=skin)
    covered = covered_pixels(scene, camera)
    if not len(covered):
        raise ValueError(f"{camera.name} does not see the subject: nothing to measure")
    index = covered[:: max(1, len(covered) // pixels)]
    path = PathReference(scene, max_depth)

    def ours(samples: int, seed: int) -> Image:
        return render_olat(
            scene, camera, lights, spp=samples, max_depth=max_depth, seed=seed, pixels=index
        )

    def mitsuba(samples: int, seed: int) -> Image:
        return path.render(camera, lights, index, spp=samples, seed=seed)

    halves = [ours(max(1, reference_spp // 2), seed + k) for k in (1, 2)]
    path.render(camera, lights[:1], index, spp=1, seed=seed)
    series = [_measure("ours", ours, n, seed + 10 + n, halves) for n in spp]
    series += [_measure("mitsuba path", mitsuba, n, seed + 10 + n, halves) for n in path_spp]
    last = {s["method"]: s for s in series}
    result = {
        "lights": len(lights),
        "pixels": len(index),
        "strands": len(strands),
        "max_depth": max_depth,
        "reference_spp": reference_spp,
        "series": series,
        "gain": _cost(last["mitsuba path"], "seconds") / _cost(last["ours"], "seconds"),
        "gain_cpu": _cost(last["mitsuba path"], "cpu_seconds") / _cost(last["ours"], "cpu_seconds"),
    }
    out.mkdir(parents=True, exist_ok=True)
    (out / "olat.json").write_text(json.dumps(result, indent=2) + "\n")
    _plot(out / "olat.png", result)
    return result


def _measure(
    method: str, render: Callable[[int, int], Image], spp: int, seed: int, halves: list[Image]
) -> dict[str, Any]:
    """One point of a curve."""
    wall, cpu = time.perf_counter(), time.process_time()
    image = render(spp, seed)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    return {
        "method": method,
        "spp": spp,
        "seconds": wall,
        "cpu_seconds": cpu,
        "rel_mse": relative_mse(image, halves[0], halves[1]),
    }


def relative_mse(image: Image, first: Image, second: Image) -> float:
    """Relative mean squared error of `image (L, P, 3)`, without the reference's own variance.

    The reference is the mean of two independent unbiased renders `first` and `second`; a quarter
    of their mean squared difference is its variance. Lights weigh alike; lights that reach
    nothing are left out.
    """
    axes = (1, 2)
    a, b = first.astype(float), second.astype(float)
    noise = ((a - b) ** 2).mean(axes) / 4
    power = ((a + b) ** 2).mean(axes) / 4 - noise
    error = ((image - (a + b) / 2) ** 2).mean(axes) - noise
    reached = power > 0
    if not reached.any():
        raise ValueError("no light reaches the subject: there is no error to speak of")
    return float((error[reached] / power[reached]).mean())


def _cost(point: dict[str, Any], clock: str) -> float:
    return float(point["rel_mse"] * point[clock])


def _plot(path: Path, result: dict[str, Any]) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for method in ("mitsuba path", "ours"):
        points = [s for s in result["series"] if s["method"] == method]
        axes.loglog(
            [s["seconds"] for s in points], [s["rel_mse"] for s in points], "o-", label=method
        )
    axes.set_xlabel("seconds")
    axes.set_ylabel("relative mean squared error")
    axes.set_title(
        f"{result['lights']} lights one at a time, {result['pixels']} pixels: "
        f"{result['gain']:.1f} times faster to the same error",
        fontsize=10,
    )
    axes.grid(True, which="both", alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=120)

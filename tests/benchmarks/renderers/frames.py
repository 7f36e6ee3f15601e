"""Frames beside many paths: error against CPU time of the ways to render them.

Judged on pixels of hair under held-out lights, as the demo judges pictures; then extreme hair and
lights (`extremes`), as the simulators render them; then pictures under maps. Leaves `frames.json`
and `frames.png`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from appearance import HairScene, Sampling, render_environment, render_olat
from appearance.metrics.scores import Exposure
from appearance.model.relight import three_quarter_view
from appearance.render.coverage import coverage, covered_pixels
from appearance.render.environment_maps import PROCEDURAL
from appearance.render.smoothed import environment_smoothed, olat_smoothed
from benchmarks.command import SUBJECT, Benchmark, option
from benchmarks.renderers.cost import hair_pixels
from benchmarks.renderers.extremes import Extreme, extremes
from benchmarks.results import Panel, draw_panels, save
from benchmarks.subjects import simulated
from reconstruction import Camera, Light, Progress, Rig, Strands
from reconstruction.arrays import Array, Floats, Ints

PLAIN, SMOOTHED, CHOSEN = "render_olat", "olat_smoothed", "chosen"
DEPTH = 16
"""Vertices a path may have, as in the simulators."""
SEEDS = option("--seeds", "how many", type=int, default=2)


@dataclass(frozen=True)
class Effort:
    """Paths a pixel of each method, of the frames as `chosen`, and of what they are held against;
    pixels and lights that are judged; a small picture's share of the camera's, that is timed."""

    plain: Sequence[int] = (4, 16, 64)
    smoothed: Sequence[int] = (4, 9, 16, 36)
    chosen: int = 16
    reference: int = 4096
    pixels: int = 300
    every_nth_light: int = 28
    cameras: int = 8
    timed: float = 0.2
    maps: tuple[int, int, Sequence[int], int] = 640, 64, (1, 3, 6, 12, 32), 1024
    """Side of a picture under a map, and of its middle that is judged; paths a pixel, and of what
    it is held against."""


QUICK = Effort((2, 4), (2, 4), 4, 32, 30, 160, 1, 0.05, (24, 12, (1,), 8))


def methods(effort: Effort) -> dict[tuple[str, int], Callable[..., Floats]]:
    """By name and paths: `(scene, camera, lights, pixels, seed)` to radiance `(L, P, 3)`."""

    def plain(spp: int) -> Callable[..., Floats]:
        return lambda scene, camera, lights, pixels, seed: render_olat(
            scene, camera, lights, spp=spp, max_depth=DEPTH, seed=seed, pixels=pixels
        )

    def smooth(spp: int) -> Callable[..., Floats]:
        return lambda scene, camera, lights, pixels, seed: olat_smoothed(
            scene, camera, lights, Sampling(spp, DEPTH, seed), pixels=pixels
        )

    found = {(PLAIN, spp): plain(spp) for spp in effort.plain}
    return found | {(SMOOTHED, spp): smooth(spp) for spp in effort.smoothed}


def cost(scene: HairScene, camera: Camera, lights: Sequence[Light], effort: Effort) -> Array:
    """CPU seconds of each method for all `lights` in a small picture, over plain 16 paths'.

    The second call counts: the first compiles.
    """
    K = camera.K.copy()
    K[:2] *= effort.timed
    width, height = (max(int(effort.timed * n), 8) for n in (camera.width, camera.height))
    small = replace(camera, K=K, width=width, height=height)
    pixels = covered_pixels(scene, small)
    seconds = []
    for render in (methods(replace(effort, plain=(16,)))[PLAIN, 16], *methods(effort).values()):
        for seed in (1, 2):
            start = time.process_time()
            render(scene, small, lights, pixels, seed)
            cpu_s = time.process_time() - start
        seconds.append(cpu_s)
    return np.array(seconds[1:]) / seconds[0]


def _reference(
    scene: HairScene, camera: Camera, lights: Sequence[Light], pixels: Ints, spp: int
) -> tuple[Floats, Floats]:
    """Two independent halves of what frames are held against."""
    one, other = (
        render_olat(
            scene, camera, lights, spp=spp // 2, max_depth=DEPTH, seed=1000 + k, pixels=pixels
        )
        for k in (0, 1)
    )
    return one, other


def psnrs(image: Floats, truth: Floats, exposure: Exposure) -> list[float]:
    """PSNR in dB of each of the pictures `(L, P, 3)` against `truth`, as pictures are shown."""
    error = ((exposure(image) - exposure(truth)) ** 2).mean((1, 2))
    return [float(x) for x in -10 * np.log10(np.maximum(error, 1e-10))]


def run(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Each method's error by camera, light and seed, its mean over the reference's, and its cost.

    The reference's own error, by its halves, is in the results too: no method gets below it.
    """
    effort = QUICK if args.quick else Effort()
    rig = Rig.load(args.rig)
    subject = simulated(args.rig, args.subject, args.head, args.seed)
    scene = subject.scene()
    lights = rig.lights[effort.every_nth_light // 2 :: effort.every_nth_light]
    cameras = rig.cameras[: effort.cameras]
    pixels = [hair_pixels(scene, c, effort.pixels, 100 + k) for k, c in enumerate(cameras)]
    halves = [
        _reference(scene, c, lights, px, effort.reference)
        for c, px in zip(cameras, pixels, strict=True)
    ]
    truth = [0.5 * (one + other) for one, other in halves]
    exposure = Exposure.of(t.reshape(-1, 3) for t in truth)
    # a half differs from the other by twice the error of their mean: 6 dB
    own = [x + 6.02 for one, other in halves for x in psnrs(one, other, exposure)]
    result: dict[str, Any] = {
        "lights": len(lights),
        "cameras": len(cameras),
        "reference": {"spp": effort.reference, **_summary(own)},
        "series": [],
    }
    costs = cost(scene, cameras[0], rig.lights, effort)
    for k, ((name, spp), render) in enumerate(methods(effort).items()):
        progress(f"{name}, {spp} paths", k / (len(costs) + 1))
        found, means = list[float](), []
        for seed in range(args.seed, args.seed + args.seeds):
            for camera, px, true in zip(cameras, pixels, truth, strict=True):
                image = render(scene, camera, lights, px, seed)
                found += psnrs(image, true, exposure)
                means.append(image.mean() / true.mean())
        result["series"].append(
            {
                "method": name,
                "spp": spp,
                "chosen": (name, spp) == (SMOOTHED, effort.chosen),
                "cost": float(costs[k]),
                **_summary(found),
                "mean": float(np.mean(means)),
                **({"mean_sd": float(np.std(means, ddof=1))} if len(means) > 1 else {}),
            }
        )
        save(args.out / "frames.json", result)
    draw_panels(args.out / "frames.png", [[_panel(result["series"])]])
    progress("extremes", 1 - 1 / (len(costs) + 1))
    result["extremes"] = {
        e.name: _extreme(e, cameras[0], effort) for e in extremes(subject, lights)
    }
    result["maps"] = {name: _mapped(scene, subject.strands, name, effort) for name in PROCEDURAL}
    save(args.out / "frames.json", result)
    return result


def _mapped(scene: HairScene, strands: Strands, name: str, effort: Effort) -> dict[str, Any]:
    """CPU seconds of a whole picture and error on the hair in its middle, by paths a pixel.

    Of `environment_smoothed`. `bias_db` is of the product of the errors of seeds 1 and 2 against
    independent halves.
    """
    size, judged, paths, many = effort.maps
    whole, envmap = three_quarter_view(strands, size), PROCEDURAL[name]()
    K = whole.K.copy()
    K[:2, 2] -= (size - judged) // 2
    camera = replace(whole, K=K, width=judged, height=judged)
    hair = coverage(scene, camera)["hair"] > 0.5
    halves = [
        render_environment(scene, camera, envmap, Sampling(many // 2, DEPTH, 1000 + k))[hair]
        for k in (0, 1)
    ]
    exposure, found = Exposure.of(halves), dict[str, Any]()
    truth = [exposure(x) for x in halves]
    noise = float(((truth[0] - truth[1]) ** 2).mean()) / 4
    for spp in paths:
        images = []
        for view, seed in ((camera, 1), (camera, 2), (whole, 1)):  # the first compiles
            start = time.process_time()
            image = environment_smoothed(scene, view, envmap, Sampling(spp, DEPTH, seed))
            cpu_s = time.process_time() - start
            if view is camera:
                images.append(image[hair])
        off = [[exposure(x) - t for t in truth] for x in images]
        each = [((one + other) ** 2).mean() / 4 - noise for one, other in off]
        error, shared = float(np.mean(each)), float((off[0][0] * off[1][1]).mean())
        found[str(spp)] = {
            "cpu_seconds": cpu_s,
            "psnr_db": -10 * float(np.log10(max(error, 1e-10))),
            "bias_db": -10 * float(np.log10(max(shared, 1e-10))),
            "mean": float(np.mean(images) / np.mean(halves)),
        }
    return found


def _extreme(extreme: Extreme, camera: Camera, effort: Effort) -> dict[str, float]:
    """The error of the frames as `chosen` on one camera's picture, seed 1."""
    scene = extreme.subject.scene()
    pixels = hair_pixels(scene, camera, effort.pixels, 100, least=0.05)
    one, other = _reference(scene, camera, extreme.lights, pixels, effort.reference)
    truth = 0.5 * (one + other)
    image = methods(effort)[SMOOTHED, effort.chosen](scene, camera, extreme.lights, pixels, 1)
    if not truth.any():
        return {"largest": float(image.max())}
    exposure = Exposure.of([truth.reshape(-1, 3)])
    own = [x + 6.02 for x in psnrs(one, other, exposure)]
    return {
        **_summary(psnrs(image, truth, exposure)),
        "mean": float(image.mean() / truth.mean()),
        "reference_db": float(np.median(own)),
        "pixels": len(pixels),
    }


def _summary(values: Sequence[float]) -> dict[str, float]:
    median, low = np.percentile(values, (50, 5))
    return {"median_db": float(median), "fifth_percentile_db": float(low)}


def _panel(series: Sequence[dict[str, Any]]) -> Panel:
    curves = {
        name: [(p["cost"], p["median_db"]) for p in series if p["method"] == name]
        for name in (PLAIN, SMOOTHED)
    }
    curves[CHOSEN] = [(p["cost"], p["median_db"]) for p in series if p["chosen"]]
    styles = {PLAIN: "k.-", SMOOTHED: "C0o-", CHOSEN: "C3*"}
    return Panel("", curves, "CPU time over render_olat's at 16", "dB", ("log", "linear"), styles)


BENCHMARK = Benchmark(run, (*SUBJECT, SEEDS))

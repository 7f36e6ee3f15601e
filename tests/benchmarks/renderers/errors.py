"""Benchmark of the renderers: error against time beside Mitsuba's `path`, and how cost grows."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from appearance.render.bounces import bounce_limit
from appearance.render.coverage import coverage
from appearance.render.olat import render_olat
from appearance.render.paths import Surface, stream, wave
from appearance.scene.hair_appearance import HairAppearance
from appearance.scene.hair_scene import HairScene, build_scene
from benchmarks.renderers.path_reference import PathReference
from benchmarks.renderers.plots import plot_errors, plot_growth
from benchmarks.renderers.scanlines import measure_scanlines
from reconstruction.array_backend import for_kernels
from reconstruction.arrays import Floats, Ints
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.lights import Light, dome_positions
from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.projectors import Projector
from reconstruction.geometry.strands import Strands

DEGREE = 6
_JUDGED = 12  # lights whose error is measured


@dataclass(frozen=True)
class Subject:
    """What is rendered."""

    strands: Strands
    head: Mesh | None
    hair: HairAppearance
    skin: tuple[float, float, float]


@dataclass(frozen=True)
class Effort:
    """How much the benchmark measures; the defaults take a quarter of an hour on two cores."""

    lights: Sequence[int] = (8, 36, 331)
    pixels: int = 2000
    spp: Sequence[int] = (4, 16, 48)
    path_spp: Sequence[int] = (4, 8)
    reference_spp: int = 128
    strands: Sequence[int] = (1_000, 10_000, 100_000)
    bounces: Sequence[int] = (1, 2, 4, 8, 16, 32)
    growth_pixels: Sequence[int] = (200, 800, 3200)
    growth_spp: int = 32
    rows: int = 768


def run(
    out: Path,
    subjects: Mapping[str, Subject],
    camera: Camera,
    *,
    effort: Effort | None = None,
    seed: int = 0,
    progress: Callable[[str, float], None] = lambda text, share: None,
) -> dict[str, Any]:
    """Measure all; write `light.json`, `light.png` and `light_growth.png` into `out`.

    The error is the mean squared error over the mean square of the reference, averaged over the
    same 12 random lights of the dome for every method. The reference is Mitsuba's `path` light by
    light; its two halves are independent, so that its own variance can be taken off. Methods take
    turns in one process, and kernels are compiled before a clock starts; what tracing them again
    takes (some 0.1 s each, three for `render_olat`) counts. Times are of all lights;
    `path` renders the judged ones and its time is scaled to all, as it does them one by one.
    """
    effort = Effort() if effort is None else effort
    out.mkdir(parents=True, exist_ok=True)
    result: dict[str, Any] = {"camera": [camera.width, camera.height], "subjects": {}}
    for k, (name, subject) in enumerate(subjects.items()):
        progress(name, k / (len(subjects) + 1))
        scene = build_scene(subject.strands, subject.head, hair=subject.hair, skin=subject.skin)
        result["subjects"][name] = _errors(scene, camera, effort, seed)
        result["subjects"][name]["strands"] = len(subject.strands)
    name, subject = next(iter(subjects.items()))
    progress("growth and scanlines", len(subjects) / (len(subjects) + 1))
    scene = build_scene(subject.strands, subject.head, hair=subject.hair, skin=subject.skin)
    result["growth"] = _growth(subject, scene, camera, effort, seed)
    projector = Projector.look_at("sweep", 1024, effort.rows, (0.5, -0.9, 0.4), (0, 0, -0.02), 24.0)
    result["scanlines"] = measure_scanlines(
        scene, camera, projector, hair_pixels(scene, camera, 300, seed), seed=seed
    )
    (out / "light.json").write_text(json.dumps(result, indent=1) + "\n")
    plot_errors(out / "light.png", result)
    plot_growth(out / "light_growth.png", result)
    return result


def hair_pixels(scene: HairScene, camera: Camera, count: int, seed: int) -> Ints:
    """At most `count` pixels that hair covers more than half, in random places, sorted."""
    covered = np.flatnonzero(coverage(scene, camera)["hair"].ravel() > 0.5)
    if not len(covered):
        raise ValueError(f"{camera.name} does not see the hair: nothing to measure")
    return np.sort(np.random.default_rng(seed).permutation(covered)[:count])


def dome(count: int, seed: int) -> list[Light]:
    """`count` of the 331 lights of a dome of 1.2 m; fewer are a part of more, in random order."""
    places = dome_positions(331, 1.2, -50.0)
    order = np.random.default_rng(seed).permutation(len(places))[:count]
    return [Light(f"lamp_{i:03d}", places[i], np.full(3, 8.0)) for i in order]


def _errors(scene: HairScene, camera: Camera, effort: Effort, seed: int) -> dict[str, Any]:
    """Error against time of one subject under each number of lights."""
    index = hair_pixels(scene, camera, effort.pixels, seed)
    limit = bounce_limit(scene, camera, pixels=index, seed=seed)
    path = PathReference(scene, limit.depth)
    judged = dome(_JUDGED, seed)
    path.render(camera, judged[:1], index, spp=1, seed=seed)
    halves = [
        path.render(camera, judged, index, spp=effort.reference_spp // 2, seed=seed + k)
        for k in (1, 2)
    ]
    entry: dict[str, Any] = {
        "pixels": len(index),
        "bounces": {"limit": limit.depth, "left_out": limit.left_out, "bound": limit.bound},
        "reference_spp": effort.reference_spp,
        "agreement": _agreement(scene, camera, judged, index, limit.depth, halves, effort, seed),
        "lights": {},
    }
    for count in effort.lights:
        lights = dome(count, seed)
        seen = min(count, _JUDGED)

        def ours(spp: int, seed: int, degree: int | None = None, lights: Any = lights) -> Floats:
            return render_olat(
                scene,
                camera,
                lights,
                spp=spp,
                seed=seed,
                pixels=index,
                max_depth=limit.depth,
                degree=degree,
            )

        def projected(spp: int, seed: int, lights: Any = lights) -> Floats:
            return ours(spp, seed, DEGREE, lights)

        def theirs(spp: int, seed: int, seen: int = seen) -> Floats:
            return path.render(camera, judged[:seen], index, spp=spp, seed=seed)

        methods: dict[str, Callable[[int, int], Floats]] = {
            "ours": ours,
            "ours projected": projected,
            "mitsuba path": theirs,
        }
        for method in [*methods.values()] * 2:  # a second call may compile a second variant
            method(min(effort.spp), seed)
        series = []
        for turn in range(max(len(effort.spp), len(effort.path_spp))):
            for name, method in methods.items():
                counts = effort.path_spp if name == "mitsuba path" else effort.spp
                if turn < len(counts):
                    scale = count / seen if name == "mitsuba path" else 1.0
                    point = _measure(method, counts[turn], seed + 10 + turn, halves, seen, scale)
                    series.append({"method": name, **point})
        entry["lights"][str(count)] = {"series": series, "gain": _gains(series)}
    return entry


def _measure(
    method: Callable[[int, int], Floats],
    spp: int,
    seed: int,
    halves: list[Floats],
    seen: int,
    scale: float,
) -> dict[str, float]:
    """One point of a curve."""
    wall, cpu = time.perf_counter(), time.process_time()
    image = method(spp, seed)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    return {
        "spp": spp,
        "seconds": wall * scale,
        "cpu_seconds": cpu * scale,
        "rel_mse": relative_mse(image[:seen], halves[0][:seen], halves[1][:seen]),
    }


def relative_mse(image: Floats, first: Floats, second: Floats) -> float:
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


def _gains(series: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """How many times longer `path` takes to the error of each of our points.

    `path` is unbiased: error x time is one number, averaged over its points.
    """
    gains: dict[str, dict[str, float]] = {}
    for clock in ("seconds", "cpu_seconds"):
        theirs = np.mean([p["rel_mse"] * p[clock] for p in series if p["method"] == "mitsuba path"])
        for p in series:
            if p["method"] != "mitsuba path":
                gain = float(theirs / (p["rel_mse"] * p[clock]))
                gains.setdefault(f"{p['method']}, {clock}", {})[str(p["spp"])] = gain
    return gains


def _agreement(
    scene: HairScene,
    camera: Camera,
    lights: Sequence[Light],
    index: Ints,
    depth: int,
    halves: list[Floats],
    effort: Effort,
    seed: int,
) -> dict[str, float]:
    """Mean radiance over lights and pixels, ours / `path`, and the ratio's standard error."""
    ours = [
        render_olat(
            scene,
            camera,
            lights,
            spp=effort.reference_spp // 2,
            seed=seed + k,
            pixels=index,
            max_depth=depth,
        )
        for k in (3, 4)
    ]
    mine, theirs = (np.mean(pair, (0, 2, 3), float) for pair in (ours, halves))  # by light
    ratio = mine.sum() / theirs.sum()
    error = (mine - ratio * theirs).std(ddof=1) / theirs.mean() / np.sqrt(len(mine))
    return {"ratio": float(ratio), "standard_error": float(error)}


def _growth(
    subject: Subject, scene: HairScene, camera: Camera, effort: Effort, seed: int
) -> dict[str, Any]:
    """Cost over strands, bounces and pixels under 36 lights, and beside the bare rays'."""
    lights = dome(36, seed)

    def cost(scene: HairScene, index: Ints, depth: int | None) -> dict[str, float]:
        spp = effort.growth_spp
        render_olat(scene, camera, lights, spp=spp, pixels=index, max_depth=depth)
        start = time.process_time()
        render_olat(scene, camera, lights, spp=spp, pixels=index, max_depth=depth, seed=seed)
        seconds = time.process_time() - start
        return {"cpu_seconds": seconds, "us_per_path": 1e6 * seconds / spp / len(index)}

    found: dict[str, Any] = {"lights": len(lights), "strands": {}, "bounces": {}, "pixels": {}}
    for count in effort.strands:
        strands = with_count(subject.strands, count, seed)
        other = build_scene(strands, subject.head, hair=subject.hair, skin=subject.skin)
        index = hair_pixels(other, camera, effort.pixels, seed)
        bare = bare_rays(other, camera, index, seed)
        one = cost(other, index, None)
        rays = one["us_per_path"] / bare["shadow_us"]
        found["strands"][str(count)] = {**one, **bare, "path_in_shadow_rays": rays}
    index = hair_pixels(scene, camera, effort.pixels, seed)
    for depth in effort.bounces:
        found["bounces"][str(depth)] = cost(scene, index, depth)
    for pixels in effort.growth_pixels:
        part = hair_pixels(scene, camera, pixels, seed)
        found["pixels"][str(len(part))] = cost(scene, part, None)
    return found


def with_count(strands: Strands, count: int, seed: int) -> Strands:
    """`count` of the strands, or copies of them a few millimetres aside, at the same coverage."""
    rng = np.random.default_rng(seed)
    whole, rest = divmod(count, len(strands))
    chosen = np.r_[np.tile(np.arange(len(strands)), whole), rng.permutation(len(strands))[:rest]]
    pieces = [strands.points[strands.offsets[i] : strands.offsets[i + 1]] for i in chosen]
    aside = rng.normal(scale=0.001, size=(count, 3)).astype(np.float32)
    if whole:
        aside[: len(strands)] = 0
    radius = float(np.mean(strands.radius)) * len(strands) / count
    moved = Strands.from_list([p + a for p, a in zip(pieces, aside, strict=True)])
    return replace(moved, radius=radius)


def bare_rays(
    scene: HairScene, camera: Camera, index: Ints, seed: int, rounds: int = 64
) -> dict[str, float]:
    """Microseconds of CPU a ray of the scene takes when nothing else is done.

    From each pixel's first hit towards random directions: `closest_us` with the surface's answer
    (`ray_intersect`), `shadow_us` (`ray_test`).
    """
    import drjit as dr
    import mitsuba as mi

    surface = Surface(scene)
    pixel = mi.UInt32(for_kernels(index, np.uint32))
    camera_paths = wave(camera, pixel, len(index), 0, 1, 1, seed)
    start = surface.interact(camera_paths.rays, mi.Bool(True))
    found = {}
    for name in ("closest_us", "shadow_us"):
        for _ in range(2):  # the first compiles
            rng = stream(len(index), seed)
            count = dr.zeros(mi.UInt32, len(index))
            dr.eval(start, count)
            begun = time.process_time()

            def body(i: Any, count: Any, rng: Any, name: str = name) -> Any:
                towards = mi.warp.square_to_uniform_sphere(
                    mi.Point2f(rng.next_float32(), rng.next_float32())
                )
                ray = start.spawn_ray(towards)
                if name == "shadow_us":
                    hit = scene.mi_scene.ray_test(ray)
                else:
                    hit = surface.interact(ray, mi.Bool(True)).t < 1
                return i + 1, count + dr.select(hit, mi.UInt32(1), 0), rng

            _, count, _ = dr.while_loop(
                (mi.UInt32(0), count, rng), lambda i, count, rng: i < rounds, body, label="rays"
            )
            dr.eval(count)
            dr.sync_thread()
            seconds = time.process_time() - begun
        found[name] = 1e6 * seconds / rounds / len(index)
    return found

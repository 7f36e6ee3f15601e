"""What a path costs over strands, bounces, pixels and lights, and beside bare rays."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance import HairScene, render_olat
from appearance.render.coverage import coverage
from appearance.render.paths import Surface, stream, wave
from benchmarks.results import Panel
from benchmarks.subjects import Subject
from reconstruction import Camera, Light, Strands
from reconstruction.array_backend import for_kernels
from reconstruction.arrays import Ints


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


@dataclass(frozen=True)
class View:
    """What is rendered: the flat pixels `index (P,)` of a camera's picture."""

    scene: HairScene
    camera: Camera
    index: Ints
    seed: int

    @classmethod
    def of(cls, subject: Subject, camera: Camera, pixels: int, seed: int) -> View:
        """At most `pixels` of hair in a subject's picture."""
        scene = subject.scene()
        return cls(scene, camera, hair_pixels(scene, camera, pixels, seed), seed)


def hair_pixels(
    scene: HairScene, camera: Camera, count: int, seed: int, least: float = 0.5
) -> Ints:
    """At most `count` pixels of which hair covers more than `least`, in random places, sorted."""
    covered = np.flatnonzero(coverage(scene, camera)["hair"].ravel() > least)
    if not len(covered):
        raise ValueError(f"{camera.name} does not see the hair: nothing to measure")
    return np.sort(np.random.default_rng(seed).permutation(covered)[:count])


def growth(subject: Subject, view: View, lights: list[Light], effort: Effort) -> dict[str, Any]:
    """Cost over strands, bounces and pixels, and beside the bare rays'."""
    seed, spp = view.seed, effort.growth_spp

    def cost(view: View, depth: int | None = None) -> dict[str, float]:
        scene, index = view.scene, view.index
        render_olat(scene, view.camera, lights, spp=spp, pixels=index, max_depth=depth)
        start = time.process_time()
        render_olat(scene, view.camera, lights, spp=spp, pixels=index, max_depth=depth, seed=seed)
        seconds = time.process_time() - start
        return {"cpu_seconds": seconds, "us_per_path": 1e6 * seconds / spp / len(index)}

    found: dict[str, Any] = {"lights": len(lights), "strands": {}, "bounces": {}, "pixels": {}}
    for count in effort.strands:
        strands = with_count(subject.strands, count, seed)
        other = View.of(replace(subject, strands=strands), view.camera, effort.pixels, seed)
        bare, one = bare_rays(other), cost(other)
        rays = one["us_per_path"] / bare["shadow_us"]
        found["strands"][str(count)] = {**one, **bare, "path_in_shadow_rays": rays}
    for depth in effort.bounces:
        found["bounces"][str(depth)] = cost(view, depth)
    for pixels in effort.growth_pixels:
        part = replace(view, index=hair_pixels(view.scene, view.camera, pixels, seed))
        found["pixels"][str(len(part.index))] = cost(part)
    return found


def growth_panels(result: dict[str, Any]) -> list[Panel]:
    """CPU time of a path over strands, bounces and pixels, and over lights."""
    found = result["growth"]
    panels = []
    for what in ("strands", "bounces", "pixels"):
        points = [(int(n), p["us_per_path"]) for n, p in found[what].items()]
        y = f"µs a path, {found['lights']} lights"
        panels.append(Panel("", {"ours": points}, what, y, ("log", "linear")))
    curves = {}
    for name, subject in result["subjects"].items():
        curves[name] = [
            (int(count), 1e6 * p["cpu_seconds"] / p["spp"] / subject["pixels"])
            for count, entry in subject["lights"].items()
            for p in [q for q in entry["series"] if q["method"] == "ours"][-1:]
        ]
    return [*panels, Panel("", curves, "lights", "µs a path")]


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


def bare_rays(view: View, rounds: int = 64) -> dict[str, float]:
    """Microseconds of CPU a ray of the scene takes when nothing else is done.

    From each pixel's first hit towards random directions: `closest_us` with the surface's answer
    (`ray_intersect`), `shadow_us` (`occluded`).
    """
    scene, lanes = view.scene, len(view.index)
    surface = Surface(scene)
    pixel = mi.UInt32(for_kernels(view.index, np.uint32))
    camera_paths = wave(view.camera, pixel, lanes, 0, 1, 1, view.seed)
    start = surface.interact(camera_paths.rays, mi.Bool(True))
    found = {}
    for name in ("closest_us", "shadow_us"):
        for _ in range(2):  # the first compiles
            rng = stream(lanes, view.seed)
            count = dr.zeros(mi.UInt32, lanes)
            dr.eval(start, count)
            begun = time.process_time()

            def body(i: Any, count: Any, rng: Any, name: str = name) -> Any:
                towards = mi.warp.square_to_uniform_sphere(
                    mi.Point2f(rng.next_float32(), rng.next_float32())
                )
                ray = start.spawn_ray(towards)
                if name == "shadow_us":
                    hit = scene.occluded(ray)
                else:
                    hit = surface.interact(ray, mi.Bool(True)).t < 1
                return i + 1, count + dr.select(hit, mi.UInt32(1), 0), rng

            _, count, _ = dr.while_loop(
                (mi.UInt32(0), count, rng), lambda i, count, rng: i < rounds, body, label="rays"
            )
            dr.eval(count)
            dr.sync_thread()
            seconds = time.process_time() - begun
        found[name] = 1e6 * seconds / rounds / lanes
    return found

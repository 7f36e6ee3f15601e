"""Captured frames interpolated on strands, standard and guided, beside inverse rendering's start.

A small simulated stage: some cameras, one more between them, and lights on a dome of which every
eighth is held out. Strands to interpolate on are bent by 5° RMS, stage 1 is emulated: the true
material with a roughness 7 % off, on those strands. Samples are smoothed as a simulated capture's;
the held-out frames that judge are two independent halves of many paths, so that their noise falls
out. Leaves `interpolation.json`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from appearance import Exposure, build_scene, render_olat
from appearance.bsdf.maps import MappedStrands, scalp_coordinates
from appearance.fields.hits import find_hits
from appearance.fields.interpolation import HITS, Interpolation
from appearance.fields.reflectance import CapturedView, ReflectanceField
from appearance.fields.search import blocks, searched
from appearance.render.coverage import coverage
from appearance.render.smoothed import olat_smoothed
from appearance.render.tracing import Sampling
from benchmarks.appearance.known_subjects import bent
from benchmarks.command import SUBJECT, Benchmark, option, within
from benchmarks.results import save, spread
from benchmarks.subjects import Subject, simulated
from reconstruction import Camera, Light, Progress, Stage
from reconstruction.arrays import AnyFloats, Array, Floats, Ints
from reconstruction.geometry.lights import dome_positions

SEEDS = option("--seeds", "how many subjects, from --seed on", type=int, default=3)
DEPTH = 12
HIGHLIGHTS = 0.9
"""Quantile of a frame's blocks by brightness from which on they are its highlights."""


@dataclass(frozen=True)
class Size:
    """A small stage's pixels across, cameras, lights, and paths a pixel of samples and judges."""

    pixels: int = 64
    cameras: int = 3
    lights: int = 96
    spp: int = 48
    judged: int = 384


@dataclass(frozen=True, eq=False)
class Captured:
    """Frames of a subject and what judges them.

    `truth` holds two independent renderings `(held, P, 3)` of each of `cameras`, the last of which
    has no samples.
    """

    subject: Subject
    bent: MappedStrands
    interpolation: Interpolation
    cameras: Sequence[Camera]
    pixels: Sequence[Ints]
    held: Sequence[Light]
    truth: Sequence[Array]
    exposure: Exposure


def captured(subject: Subject, size: Size, seed: int) -> Captured:
    """Capture `subject` on a stage of that size."""
    strands, uv = subject.strands, scalp_coordinates(subject.strands, subject.head)
    scene = subject.scene()
    low, high = (f(strands.points, axis=0).astype(float) for f in (np.min, np.max))
    middle, reach = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low))
    distance = reach / np.sin(np.radians(12))
    cameras = []
    for k in range(size.cameras + 1):
        last = k == size.cameras
        angle = np.radians(-90 + 30 * (0.5 if last else k - size.cameras // 2))
        height = 0.12 if last else 0.25 * (k % 2)
        place = middle + distance * np.array([np.cos(angle), np.sin(angle), height])
        cameras.append(Camera.look_at(f"cam_{k}", size.pixels, size.pixels, place, middle, 24))
    spots = dome_positions(size.lights, 1.2, lowest_deg=-30)
    lights = [Light(f"light_{i:02d}", p, np.full(3, 8.0)) for i, p in enumerate(spots)]
    held, kept = lights[3::8], [x for i, x in enumerate(lights) if i % 8 != 3]
    pixels = [np.flatnonzero((coverage(scene, c, 25)["hair"] > 0.7).ravel()) for c in cameras]
    views, truth = [], []
    for k, (camera, index) in enumerate(zip(cameras, pixels, strict=True)):
        number = (seed << 8) + 16 * k
        if k < size.cameras:
            sampling = Sampling(size.spp, DEPTH, number)
            table = olat_smoothed(scene, camera, kept, sampling, pixels=index)
            views.append(CapturedView(camera, index, table.astype(np.float16)))
        halves = [
            render_olat(
                scene,
                camera,
                held,
                spp=size.judged // 2,
                max_depth=DEPTH,
                pixels=index,
                seed=number + 1 + half,
            )
            for half in (0, 1)
        ]
        truth.append(np.stack(halves).astype(float))
    exposure = Exposure.of([view.table.astype(float).reshape(-1, 3) for view in views])
    wrong = bent(strands, uv, 5.0, seed)
    on = build_scene(
        wrong,
        subject.head,
        hair=replace(subject.hair, beta_m=1.07 * subject.hair.beta_m),
        skin=subject.skin,
    )
    mapped = MappedStrands.of(on, wrong, uv)
    field = ReflectanceField(tuple(kept), tuple(views), 1.0)
    made = Interpolation.of(field, mapped, wrong)
    return Captured(subject, mapped, made, cameras, pixels, held, truth, exposure)


def variants(shot: Captured, progress: Progress) -> tuple[dict[str, Interpolation], Stage]:
    """The interpolations by name, and what the search told."""
    standard, stage = shot.interpolation, Stage("search")
    names = [x.name for x in standard.field.lights]
    search = searched(standard, names[5 :: max(len(names) // 4, 1)], cameras=1, progress=progress)
    search.record(stage)
    guided = replace(standard, model=search.best)
    return {
        "standard, radial (Photobooth §4.1)": standard,
        "Kajiya-Kay, radial (Photobooth §4.2)": guided,
    }, stage


def three_nearest(shot: Captured, k: int) -> Floats:
    """The view's own frames under the three nearest lights, by inverse angle `(held, P, 3)`."""
    every = shot.interpolation.field.lights
    known, new = (
        np.array([x.position / np.linalg.norm(x.position) for x in y]) for y in (every, shot.held)
    )
    angle = np.arccos(np.clip(new @ known.T, -1, 1))
    order = np.argsort(angle, axis=1)[:, :3]
    weight = 1 / np.take_along_axis(angle, order, axis=1)
    weight /= weight.sum(axis=1, keepdims=True)
    table = shot.interpolation.field.views[k].table
    pairs = zip(weight, order, strict=True)
    return np.stack([np.tensordot(w, table[o].astype(float), 1) for w, o in pairs])


def score(shot: Captured, k: int, made: AnyFloats) -> dict[str, float]:
    """PSNR of `made (held, P, 3)` in view `k` over all of the hair and over highlights' blocks.

    In display values, without the judges' noise: the mean over pixels of the products of the
    differences from two independent halves.
    """
    display, block = shot.exposure, blocks(shot.pixels[k], shot.cameras[k].width)
    count = np.bincount(block)
    found: dict[str, list[float]] = {"hair": [], "highlights": []}
    for one, a, b in zip(made, *shot.truth[k], strict=True):
        shown = display(one)
        error = ((shown - display(a)) * (shown - display(b))).mean(axis=1)
        light = np.bincount(block, (a + b).mean(axis=1)) / count
        whole = count >= 16
        bright = whole & (light >= np.quantile(light[whole], HIGHLIGHTS))
        found["hair"].append(float(error.mean()))
        found["highlights"].append(float(error[bright[block]].mean()))
    return {n: float(-10 * np.log10(max(float(np.mean(v)), 1e-6))) for n, v in found.items()}


def measure(subject: Subject, size: Size, seed: int, progress: Progress) -> dict[str, Any]:
    """All rows of one subject: of captured cameras and of the one between."""
    shot = captured(subject, size, seed)
    rows: dict[str, dict[str, Any]] = {}
    own, new = list(range(len(shot.cameras) - 1)), len(shot.cameras) - 1

    def add(name: str, k: int, made: AnyFloats) -> None:
        group = "between" if k == new else "captured"
        rows.setdefault(name, {}).setdefault(group, []).append(score(shot, k, made))

    for k in own:
        add("three nearest lights", k, three_nearest(shot, k))
    for k in (*own, new):
        sampling = Sampling(size.judged, DEPTH, (seed << 8) + 200 + k)
        scene, camera = shot.bent.scene, shot.cameras[k]
        made = olat_smoothed(scene, camera, shot.held, sampling, pixels=shot.pixels[k])
        add("stage 1, emulated", k, made)
    found, stage = variants(shot, progress)
    seconds = {}
    for name, one in found.items():
        begun = time.process_time()
        for k in (*own, new):
            if k == new:
                hits = find_hits(shot.bent, shot.cameras[k], shot.pixels[k], HITS)
            else:
                hits = one.sources[k].hits
            add(name, k, one.at_hits(hits).under(shot.held)[0])
        seconds[name] = time.process_time() - begun
    means = {
        name: {
            group: {n: float(np.mean([v[n] for v in views])) for n in views[0]}
            for group, views in groups.items()
        }
        for name, groups in rows.items()
    }
    search = {"figures": stage.figures, "warnings": stage.warnings}
    return {"rows": means, "cpu_seconds": seconds, "search": search}


def run(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Every seed, and the mean and spread over them."""
    size = Size(32, 2, 24, 8, 16) if args.quick else Size()
    found: dict[str, Any] = {"subject": args.subject, "seeds": {}}
    for i in range(1 if args.quick else args.seeds):
        seed = args.seed + i
        subject = simulated(args.rig, args.subject, args.head, seed)
        report_progress = within(progress, f"seed {seed}", i / args.seeds, 1 / args.seeds)
        found["seeds"][seed] = measure(subject, size, seed, report_progress)
        found["mean"] = _means([x["rows"] for x in found["seeds"].values()])
        save(args.out / "interpolation.json", found)
    return found


def _means(seeds: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    return {
        name: {
            group: {n: spread([s[name][group][n] for s in seeds]) for n in values}
            for group, values in groups.items()
        }
        for name, groups in seeds[0].items()
    }


BENCHMARK = Benchmark(run, (*SUBJECT, SEEDS))

"""Hair that sways: how much its pictures change from frame to frame, beside path-traced ones.

Noise that changes looks like movement. A groom sways under the studio map; frames rendered one by
one, and by `moving`, beside two independent path-traced ones of many paths: changes and errors are
those of displayed values of hair, the truth's freed of noise by products of the two. Leaves
`moving.json`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from appearance import Environment, Exposure, FittedModel, HeldOut, Sampling
from appearance.bsdf.maps import HairMaps
from appearance.model.animation import moving, sway
from appearance.model.relight import environment_map, three_quarter_view
from appearance.render.coverage import coverage
from appearance.render.environment import direct_environment, render_environment
from appearance.render.smoothed import environment_smoothed
from appearance.sun_fit.fitted_appearance import FittedAppearance
from benchmarks.command import SUBJECT, Benchmark, option
from benchmarks.results import save
from benchmarks.subjects import Subject, simulated
from reconstruction import Progress, Strands, silent
from reconstruction.arrays import Array, Floats

TURN, DEGREES = 24, 12.0
"""Frames of a whole sway, and how far it goes."""
TRUE = 64
"""Paths a pixel of each of the truth's two pictures, and six times as many of direct light."""
PATHS = (6, 12)


def run_bench(
    subject: Subject,
    size: int,
    frames: int,
    seed: int = 0,
    *,
    true: int = TRUE,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Changes, errors and CPU seconds a frame of each variant, on the first `frames` of a sway."""
    fitted = _model(subject)
    poses = sway(subject.strands, TURN, DEGREES)[:frames]
    camera, room = three_quarter_view(subject.strands, size), environment_map("studio")
    lit = (), (Environment(room),)

    def traced(pose: Strands, number: int) -> Floats:
        scene, sampling = fitted.scene(pose), Sampling(true, seed=(seed << 10) + number)
        first, whole = (
            render_environment(scene, camera, room, replace(sampling, max_depth=depth))
            for depth in (1, sampling.max_depth)
        )
        direct = direct_environment(scene, camera, room, 6 * true, sampling.seed)
        return np.asarray(whole - first + direct)

    def path_traced(number: int) -> Floats:
        return np.stack([traced(pose, number + 2 * k) for k, pose in enumerate(poses)])

    def one_by_one() -> Floats:
        scenes = (fitted.scene(pose) for pose in poses)
        sampling = Sampling(PATHS[0], seed=seed)
        return np.stack([environment_smoothed(x, camera, room, sampling) for x in scenes])

    progress("path-traced frames", 0.0)
    truth = path_traced(100), path_traced(101)
    hair = np.stack([coverage(fitted.scene(p), camera)["hair"] for p in poses]) > 0.5
    seen = np.asarray(hair.any(axis=0))
    exposure = Exposure.of([truth[0][truth[0].sum(axis=-1) > 0]])

    def displayed(pictures: Floats) -> Array:
        return np.clip(exposure(np.maximum(pictures, 0)), 0, 1)[:, seen]

    variants: dict[str, Callable[[], Floats]] = {f"one by one, {PATHS[0]} paths": one_by_one}
    for spp in PATHS:
        variants[f"moving, {spp} paths"] = partial(
            moving, fitted, poses, camera, lit, Sampling(spp, seed=seed)
        )
    halves = displayed(truth[0]), displayed(truth[1])
    rows: dict[str, Any] = {}
    for k, (name, made) in enumerate(variants.items()):
        progress(name, (k + 1) / (len(variants) + 1))
        begun = time.process_time()
        found = made()
        seconds = (time.process_time() - begun) / len(poses)
        rows[name] = {**compared(displayed(found), halves), "cpu_seconds_a_frame": seconds}
    return {"size": size, "frames": frames, "truth": changes(halves), "variants": rows}


def changes(true: tuple[Array, Array]) -> dict[str, float]:
    """The mean square of how far a truth's two pictures `(T, P, 3)` change, without their noise,
    and its standard error, which tells whether they have paths enough."""
    products = np.prod([np.diff(x, axis=0) for x in true], axis=0).mean(axis=(0, 2))
    error = float(products.std() / len(products) ** 0.5)
    return {"mean_square": float(products.mean()), "standard_error": error}


def compared(shown: Array, true: tuple[Array, Array]) -> dict[str, float]:
    """How far frames `(T, P, 3)` change, and how far they are off the truth's two, RMS."""
    change = float((np.diff(shown, axis=0) ** 2).mean())
    off = float(((shown - true[0]) * (shown - true[1])).mean())
    return {"change": change**0.5, "error": max(off, 0.0) ** 0.5}


def _model(subject: Subject) -> FittedModel:
    known = FittedAppearance(
        subject.hair, (0.4, 0.3, 0.2), subject.skin, Exposure(1.0), 0.1, 0.1, 0.1, HeldOut()
    )
    maps = HairMaps.of(subject.hair)
    return FittedModel(strands=subject.strands, head=subject.head, appearance=known, maps=maps)


def _bench(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    subject = simulated(args.rig, args.subject, args.head, args.seed)
    size, frames = (24, 2) if args.quick else (args.size, args.frames)
    result = run_bench(subject, size, frames, args.seed, progress=progress)
    save(args.out / "moving.json", result)
    return result


SIZE = option("--size", "of the frames, in pixels", type=int, default=96)
FRAMES = option("--frames", f"of the {TURN} of a sway", type=int, default=4)
BENCHMARK = Benchmark(_bench, (*SUBJECT, SIZE, FRAMES))
"""Flicker of hair that sways."""

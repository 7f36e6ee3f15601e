"""Patterns of lights beside single lights, at the same total exposure time.

156 lights are shot alone, or as 156, 64 and 13 on/off patterns of half of them, with photon and
read noise and without a full well. Pictures: single lights by least squares, of least norm where
patterns do not determine them. Fits: of the frames as they are, Sun's start and the shared stage.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import Any

import numpy as np

from appearance import Exposure
from appearance.bsdf.maps import HairMaps
from appearance.inverse_rendering.loop import run
from appearance.inverse_rendering.problem import FitProblem
from appearance.observations import Observed
from appearance.sun_fit.options import FitOptions
from benchmarks.appearance.hair_inverse import hair_inverse
from benchmarks.appearance.known_subjects import Captured, SmallStage, known_subject
from benchmarks.command import SUBJECT, Benchmark
from benchmarks.results import markdown, save
from benchmarks.subjects import simulated
from reconstruction import Progress
from reconstruction.arrays import Array
from reconstruction.capture.light_patterns import Demultiplexing
from reconstruction.geometry.lights import LightPattern

ENDS = {"bright": (2e4, 2.0), "dim": (20.0, 5.0)}
"""Electrons of white in a single light's frame, and of read noise, standard deviation."""
BETA_M = 0.2
"""The subject's roughness, far from the guess that a fit of patterns starts from."""


def on_off(count: int, seed: int) -> Array:
    """A circulant `(count, count)` of 0 and 1, half of them 1, whose inverse is small by exchanges,
    as no S-matrix has the order 156."""
    rng = np.random.default_rng(seed)
    row, best = np.arange(count) % 2, np.inf
    for _ in range(200 * count):
        trial = row.copy()
        i, j = rng.integers(count, size=2)
        trial[[i, j]] = trial[[j, i]]
        cost = (1 / np.maximum(np.abs(np.fft.fft(trial)) ** 2, 1e-9)).mean()
        best, row = (cost, trial) if cost < best else (best, row)
    return np.stack([np.roll(row, k) for k in range(count)]).astype(float)


def under(o: Observed, weights: Array, end: str, white: float, rng: Any) -> Observed:
    """The noisy frames of a view under patterns `weights (P, L)`; all take the time of L frames."""
    electrons, read = ENDS[end]
    per_unit = electrons / white * len(o.lights) / len(weights)
    clean = np.tensordot(weights, o.radiance.astype(float), 1)
    counts = rng.poisson(clean * per_unit) + rng.normal(0, read, clean.shape)
    lights: list[Any] = list(o.lights)
    if len(weights) < len(lights) or weights.sum() > len(lights):
        lit = [np.flatnonzero(row) for row in weights]
        lights = [
            LightPattern(f"p_{k}", tuple(o.single_lights[i] for i in x), weights[k, x])
            for k, x in enumerate(lit)
        ]
    radiance, valid = (counts / per_unit).astype(np.float32), np.ones(clean.shape[:2], bool)
    return replace(o, lights=tuple(lights), radiance=radiance, valid=valid)


def errors(captured: Captured, maps: HairMaps, seed: int) -> dict[str, float]:
    """Relative errors of roughness, of absorption in the worst channel, and, root mean square, of
    held-out views under held-out lights, without the noise of renderings."""
    off = size = 0.0
    scene, rig = captured.mapped.with_maps(maps).with_skin(captured.skin), captured.rig
    few = np.array(captured.held_lights[:: max(1, len(captured.held_lights) // 8)])
    for k in captured.held_views:
        o = captured.views[k].under(few)
        sampling = (rig.judged_spp, seed + 99)
        shown = rig.halves(scene, o.camera, o.single_lights, o.pixels, sampling)
        true = [half[few] for half in captured.halves[k]]
        off += float(np.prod(np.subtract(shown, true), axis=0, dtype=float).sum())
        size += float(np.prod(true, axis=0, dtype=float).sum())
    ratio = maps.sigma_a.mean(axis=(0, 1, 2)) / captured.truth.sigma_a.mean(axis=(0, 1, 2))
    beta_m = maps.beta_m / captured.truth.beta_m - 1
    return {
        "β_M": beta_m,
        "σ_a": float(np.abs(ratio - 1).max()),
        "relit": float((max(off, 0.0) / size) ** 0.5),
    }


def measure(captured: Captured, end: str, weights: Array, seed: int) -> dict[str, float]:
    """The noise gains, and the errors of pictures and fits of one set of frames."""
    training, white = captured.training(), 1 / captured.exposure.scale
    rng, solution = np.random.default_rng([seed, len(weights)]), Demultiplexing(weights)
    views = [under(o, weights, end, white, rng) for o in training]
    single = np.concatenate([np.tensordot(solution.matrix, o.radiance, 1) for o in views], axis=1)
    true = np.concatenate([o.radiance for o in training], axis=1)
    quick = FitOptions(hair_pixels=200, roughness_spp=12, colour_spp=8)
    start = HairMaps.of(hair_inverse(captured.mapped.scene, views, options=quick, seed=seed)[0])
    scale = Exposure.of([o.radiance for o in views]).scale
    problem = FitProblem(captured.mapped, views, scale, captured.skin)
    found = run(problem, start, stages=("shared",), seed=seed).maps
    out = {"pictures": float(np.linalg.norm(single - true) / np.linalg.norm(true))}
    for name, maps in (("start", start), ("fit", found)):
        out |= {f"{name} {k}": v for k, v in errors(captured, maps, seed).items()}
    gains = {"read": solution.read_gain, "photon": solution.photon_gain}
    return {**{k: float(g.mean()) for k, g in gains.items() if solution.spans}, **out}


def _bench(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    count, counts = (12, (12, 5)) if args.quick else (156, (156, 64, 13))
    subject = simulated(args.rig, args.subject, args.head, args.seed)
    subject = replace(subject, hair=replace(subject.hair, beta_m=BETA_M))
    progress("rendering", 0.0)
    rig = SmallStage(size=32, cameras=5, lights=2 * count, spp=256, judged_spp=256, max_depth=8)
    captured = known_subject("a", subject, rig, args.seed)
    full = on_off(count, args.seed)
    few = np.random.default_rng(args.seed).permutation(count)
    cases = {"single lights": np.eye(count)} | {f"{n} patterns": full[few[:n]] for n in counts}
    truth = errors(captured, captured.truth, args.seed)
    found = {"truth": {f"fit {k}": v for k, v in truth.items()}}
    for name, (end, weights) in {
        f"{e}, {n}": (e, w) for e in ENDS for n, w in cases.items()
    }.items():
        progress(name, len(found) / 9)
        found[name] = measure(captured, end, weights, args.seed)
        save(args.out / "patterns.json", found)
    columns = list(found["bright, single lights"])
    rows = [[n, *[f"{x[c]:.3f}" if c in x else "" for c in columns]] for n, x in found.items()]
    (args.out / "patterns.md").write_text(markdown(["frames", *columns], rows))
    return found


BENCHMARK = Benchmark(_bench, SUBJECT)

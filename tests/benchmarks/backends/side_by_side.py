"""What Dr.Jit runs, by LLVM on the CPU and by CUDA on a GPU: seconds side by side, and agreement.

BSDF, OLAT, the ladder of stage 1 and line stereo's depth search. Leaves `backends.json` and
`backends.md`.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from typing import Any

import drjit as dr
import numpy as np

from benchmarks.appearance.ablations import AT_SIZE, AT_SIZE_OPTIONS, QUICK, SMALL
from benchmarks.appearance.known_subjects import SmallStage
from benchmarks.backends import jobs
from benchmarks.backends.jobs import Done
from benchmarks.command import CACHE, SUBJECT, Benchmark, LeftOut, option
from benchmarks.light_codes.rig import patch
from benchmarks.results import markdown, save
from benchmarks.strand_truth import write_hair_masks
from benchmarks.subjects import simulated
from reconstruction import Camera, Capture, Progress, ReconstructOptions, Report
from reconstruction.array_backend import VARIANT
from reconstruction.light_codes.line_strands import build_views
from reconstruction.masks import MaskedCapture, hair_masks
from stage_service.cli.support.commands import FAILED, CommandError

VARIANTS = ("llvm_ad_rgb", "cuda_ad_rgb")
STAGE = SmallStage(64, cameras=5, lights=16, spp=24, judged_spp=32, clean_spp=64)
STAGE_OPTIONS = replace(AT_SIZE_OPTIONS, shape=(6, 24, 24))
NEAR = 1e-4
"""Of their RMS, within which two numbers are near: a tenth of a millimetre of depths of a metre."""

Job = Callable[[], Done]


def _olat(pixels: int, lights: int, args: argparse.Namespace) -> Job:
    subject = simulated(args.rig, args.subject, args.head, args.seed)
    camera = Camera.look_at("view", 512, 512, (0.1, -0.9, 0.1), (0.0, 0.0, -0.02), 28.0)
    pixels, lights, spp = (40, 5, 2) if args.quick else (pixels, lights, 16)
    return partial(jobs.olat, subject, camera, pixels, lights, spp, args.seed)


def _fit(args: argparse.Namespace) -> Job:
    subject = simulated(args.rig, args.subject, args.head, args.seed)
    stage, options = STAGE, STAGE_OPTIONS
    if args.quick:
        stage, options = SMALL, QUICK
    elif args.size in AT_SIZE:
        stage, options = AT_SIZE[args.size], AT_SIZE_OPTIONS
    return partial(jobs.fit, subject, stage, options, args.seed)


def _search(args: argparse.Namespace) -> Job:
    size = {"side": 32, "cameras": 4, "spp": 1} if args.quick else {"side": 160, "cameras": 12}
    folder, truth = patch("wavy", seed=args.seed, **size).capture.make(args.cache)
    capture = Capture(folder)
    write_hair_masks(capture, truth)
    codes = ReconstructOptions().light_codes
    masked = MaskedCapture(capture, hair_masks(capture, None, capture.head))
    views, volume = build_views(masked, capture.head, Report(), options=codes)
    return partial(jobs.search, views, volume, codes.search)


def _bsdf(args: argparse.Namespace) -> Job:
    return partial(jobs.bsdf, 1000 if args.quick else 4_000_000, args.seed)


JOBS: dict[str, Callable[[argparse.Namespace], Job]] = {
    "bsdf": _bsdf,
    "olat": partial(_olat, 4000, 331),
    "picture": partial(_olat, 512 * 512, 32),
    "fit": _fit,
    "search": _search,
}


def processor(variant: str) -> str | None:
    """What a variant runs on, or None where there is no such thing here."""
    if variant.startswith("llvm"):
        return f"CPU, {len(os.sched_getaffinity(0))} threads"
    if not dr.has_backend(dr.JitBackend.CUDA):
        return None
    query = ["nvidia-smi", "--query-gpu=name", "--format=csv,noheader"]
    if shutil.which(query[0]) is None:
        return "a GPU"
    output = subprocess.run(query, capture_output=True, text=True).stdout.splitlines()
    return output[0] if output else "a GPU"


def done_by(variant: str, job: Job) -> Done:
    """Do a job in a process of its own, whose variant it is. Raises what the job raised."""
    fresh = get_context("spawn")
    with ProcessPoolExecutor(1, fresh, initializer=_choose, initargs=(variant,)) as pool:
        return pool.submit(job).result()


def _choose(variant: str) -> None:
    os.environ[VARIANT] = variant


def compared(one: Done, other: Done) -> dict[str, float]:
    """How far the second is from the first.

    `mean` over mean less one, and `rms`, the relative RMS difference, where both have a number;
    `only_one`: share of numbers that one of them lacks; `near`: share of the others that are
    within `NEAR` of one another. Raises `ValueError` where they do not have as many numbers.
    """
    a, b = one.values.astype(float), other.values.astype(float)
    if a.shape != b.shape:
        raise ValueError(f"{a.shape} numbers by one back end, {b.shape} by the other")
    has_one, has_other = np.isfinite(a), np.isfinite(b)
    both = has_one & has_other
    if not both.any():
        return {"only_one": float(np.mean(has_one != has_other))}
    off = b[both] - a[both]
    size = np.sqrt(np.mean(a[both] ** 2))
    return {
        "mean": float(b[both].mean() / a[both].mean() - 1),
        "rms": float(np.sqrt(np.mean(off**2)) / size),
        "only_one": float(np.sum(has_one != has_other) / np.sum(has_one | has_other)),
        "near": float(np.mean(np.abs(off) <= NEAR * size)),
    }


def report(result: dict[str, Any]) -> str:
    """The tables, for people."""
    variants = result["processors"]
    rows = []
    for name, found in result["jobs"].items():
        for variant in variants:
            got = found.get(variant)
            if got is None:
                continue
            said = [got["failed"]] if "failed" in got else _cells(got, found)
            rows.append([name, variants[variant], *said, *[""] * (4 - len(said))])
    head = ["job", "on", "seconds", "first time", "of the CPU's time", "figures"]
    lines = [markdown(head, rows)]
    for name, found in result["jobs"].items():
        if "compared" in found:
            figures = ", ".join(f"{k} {v:.2g}" for k, v in found["compared"].items())
            lines.append(f"- {name}, the one beside the other: {figures}\n")
    lines += [f"- {name}: not here\n" for name, on in variants.items() if on == "not here"]
    return "\n".join(lines)


def _cells(got: dict[str, Any], found: dict[str, Any]) -> list[str]:
    first = found.get(VARIANTS[0], {})
    ratio = f"{got['seconds'] / first['seconds']:.2f}" if "seconds" in first else ""
    figures = ", ".join(f"{k} {v:.4g}" for k, v in got["figures"].items())
    return [f"{got['seconds']:.3g}", f"{got['first']:.3g}", ratio, figures]


def _bench(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    on = {v: processor(v) for v in args.variants}
    if not any(on.values()):
        raise LeftOut("no CUDA device is found: leave --variants out to measure the CPU alone")
    result: dict[str, Any] = {"processors": {v: p or "not here" for v, p in on.items()}}
    result["jobs"] = {}
    failed: list[str] = []
    for k, name in enumerate(args.jobs):
        progress(name, k / len(args.jobs))
        job = JOBS[name](args)
        found: dict[str, dict[str, Any]] = {}
        result["jobs"][name] = found
        done: list[Done] = []
        for variant in [v for v in args.variants if on[v]]:
            progress(f"{name}: {variant}", (k + 0.5) / len(args.jobs))
            try:
                got = done_by(variant, job)
            except Exception as error:
                failed.append(f"{name} by {variant}")
                found[variant] = {"failed": f"{type(error).__name__}: {error}"[:2000]}
            else:
                done.append(got)
                found[variant] = {n: getattr(got, n) for n in ("first", "seconds", "figures")}
            if len(done) == 2:
                found["compared"] = compared(*done)
            save(args.out / "backends.json", result)
            (args.out / "backends.md").write_text(report(result))
    if failed:
        raise CommandError(f"failed: {', '.join(failed)}; see {args.out / 'backends.md'}", FAILED)
    return result


BENCHMARK = Benchmark(
    _bench,
    (
        *SUBJECT,
        CACHE,
        option("--size", "of the fit's pictures", type=int, choices=(64, *AT_SIZE), default=64),
        option("--jobs", "which of them", nargs="+", choices=tuple(JOBS), default=list(JOBS)),
        option("--variants", "Mitsuba's", nargs="+", choices=VARIANTS, default=list(VARIANTS)),
    ),
)

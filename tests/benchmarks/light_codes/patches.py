"""Line stereo with and without lightcodes, and fused, on patches of two heads.

And on the capture that Cycles rendered. Captures go through the wires once and are kept. Leaves
`light_codes/SUBJECT/` with `patch.json` and the models, and `light_codes.json`.
"""

from __future__ import annotations

import argparse
import shutil
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from benchmarks.command import CACHE, ONLY, Benchmark, LeftOut, cycles_folder, within
from benchmarks.light_codes.rig import TARGETS, Patch, patch
from benchmarks.pictures import picture_strands
from benchmarks.results import save
from benchmarks.strand_truth import StrandTruth, write_hair_masks
from reconstruction import (
    Capture,
    CaptureError,
    Model,
    Progress,
    ReconstructOptions,
    import_folder,
    read_strands,
    reconstruct,
    silent,
)
from reconstruction.evaluation.matching import compare_strands
from reconstruction.evaluation.visibility import Visibility
from reconstruction.methods import Method
from reconstruction.report.plots import plot_geometry
from stage_service.cli.support.tables import geometry_table

METHODS: tuple[Method, ...] = ("lmvs", "photometric", "fused")
CAMERAS, LIGHTS = (12, 6), (18, 9)
OPTIONS = ReconstructOptions()


def part_of(capture: Capture, cameras: int | None = None, lights: int | None = None) -> Capture:
    """The capture with `cameras` and `lights` of it, evenly picked in the rig's order."""
    some = [c.name for c in _every(capture.rig.cameras, cameras)]
    return capture.view(cameras=some, lights=_every(capture.olat_lights(), lights))


def _every(items: Sequence[Any], count: int | None) -> list[Any]:
    if count is None or count >= len(items):
        return list(items)
    return [items[int(i)] for i in np.linspace(0, len(items) - 1, count).round()]


def run_patch(
    out: Path,
    here: Patch,
    cache: Path,
    *,
    thinner: bool = True,
    seed: int = 0,
    samples: int = 10_000,
    progress: Progress = silent,
) -> dict[str, Any]:
    """All methods and both baselines on a patch.

    `thinner` also runs `photometric` with fewer cameras and with fewer lights. Models are
    left in `OUT/<method>`, figures in `OUT/patch.json` as they come.
    """
    folder, truth_folder = here.capture.make(cache, within(progress, "capture", 0.0, 0.4))
    capture = Capture(folder)
    write_hair_masks(capture, truth_folder)
    truth = StrandTruth(capture, truth_folder, here.ball, samples)
    options = replace(OPTIONS, seed=seed)
    runs: list[tuple[str, Method, Capture]] = [(m, m, capture) for m in METHODS]
    if thinner:
        for n in CAMERAS:
            runs.append((f"photometric, {n} cameras", "photometric", part_of(capture, cameras=n)))
        for n in LIGHTS:
            runs.append((f"photometric, {n} lights", "photometric", part_of(capture, lights=n)))
    results: dict[str, Any] = {"variants": {}}
    part = 0.6 / (len(runs) + 1)
    for k, (name, method, some) in enumerate(runs):
        model = Model(out / name.replace(", ", "_").replace(" ", "_"))
        begin = time.perf_counter(), time.process_time()
        report_progress = within(progress, name, 0.4 + k * part, part)
        report = reconstruct(some, model, method=method, options=options, progress=report_progress)
        results["variants"][name] = {
            **truth.score(model.strands()),
            "seconds": time.perf_counter() - begin[0],
            "cpu_seconds": time.process_time() - begin[1],
            "stages": {s.name: s.seconds for s in report.stages},
        }
        save(out / "patch.json", results)
    progress("baselines", 1 - part)
    results["variants"] |= truth.baselines(Model(out / "photometric"))
    save(out / "patch.json", results)
    plot_geometry(results["variants"], out / "patch.png")
    sets = {"true": truth.strands}
    for m in METHODS:
        sets[m] = here.ball.cut(Model(out / m).strands())
    picture_strands(out / "strands.png", capture.rig.cameras[0], sets)
    return results


def run_imported(
    out: Path, folder: Path, *, samples: int = 10_000, progress: Progress = silent
) -> dict[str, Any]:
    """All methods on a folder that `import_folder` reads, with true strands `strands_gt.npz`.

    A method that needs what the capture lacks has its reason under "left_out" and no scores.
    """
    shutil.rmtree(out / "capture", ignore_errors=True)
    capture = import_folder(folder, out / "capture")
    truth = read_strands(folder / "strands_gt.npz")
    results: dict[str, Any] = {"variants": {}, "left_out": {}}
    for method in METHODS:
        model = Model(out / method)
        try:
            reconstruct(capture, model, method=method, options=OPTIONS, progress=progress)
        except CaptureError as error:
            results["left_out"][method] = str(error)
            continue
        results["variants"][method] = compare_strands(
            model.strands(),
            truth,
            visibility=Visibility(capture.rig.cameras, truth, capture.head),
            samples=samples,
        )
    save(out / "imported.json", results)
    return results


def run(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Every patch of `TARGETS`, or one; fewer cameras and lights on Sintel's only."""
    if args.only not in (None, *TARGETS):
        raise LeftOut(f"no subject {args.only!r}; there are {', '.join(TARGETS)}")
    names = ["wavy"] if args.quick else [n for n in TARGETS if args.only in (None, n)]
    results: dict[str, Any] = {}
    out = args.out / "light_codes"
    for name in [*names, *["imported"] * (args.only is None and not args.quick)]:
        try:
            if name == "imported":
                results[name] = run_imported(out / name, cycles_folder(None), progress=progress)
            else:
                least = {"side": 64, "cameras": 12, "spp": 1} if args.quick else {}
                results[name] = run_patch(
                    out / name,
                    patch(name, seed=args.seed, **least),
                    args.cache,
                    thinner=name == "sintel",
                    seed=args.seed,
                    progress=progress,
                )
        except LeftOut as error:
            results[name] = {"left_out": str(error)}
            continue
        Console(stderr=True).print(geometry_table(results[name]["variants"]))
        save(args.out / "light_codes.json", results)
    return results


BENCHMARK = Benchmark(run, (CACHE, ONLY))

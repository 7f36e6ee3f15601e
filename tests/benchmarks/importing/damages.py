"""What is lost where a capture comes as a user's photographs: each damage alone, and all of them.

One capture of the demo's rig goes through the wires once and is kept. It is written out as pictures
with COLMAP's text and lights in millimetres, read by `hairstage import`, reconstructed by
`hairstage reconstruct`, fitted without some lights, and scored beside the capture itself. Leaves
`importing.json` and `importing.md`.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

from appearance import HeldOut, assess, fit
from appearance.model.options import AssessOptions
from benchmarks.command import CACHE, ONLY, Benchmark, LeftOut, within
from benchmarks.importing.folders import Written, write_folder
from benchmarks.light_planes.subjects import FRAMINGS, demo_capture, subject_capture
from benchmarks.results import markdown, save
from benchmarks.strand_truth import StrandTruth
from reconstruction import Capture, Model, Progress, ReconstructOptions, parse_options, reconstruct
from stage_service.cli.support.children import own_command
from stage_service.cli.support.commands import CommandError

ALL = "all of them, in 8-bit PNG"
DAMAGES = {
    "COLMAP text, millimetres": Written("exr"),
    "16-bit PNG": Written("png16"),
    "8-bit PNG, three exposures": Written("png8"),
    "Bayer mosaic, 14-bit TIFF": Written("bayer"),
    "a wall at 3 %, clean plates": Written("exr", wall=0.03),
    "5 % of the frames missing": Written("exr", missing=0.05),
    "2 % of the hair saturated": Written("exr", blown=True),
    ALL: Written("png8", wall=0.03, missing=0.05, blown=True),
}
"""All have COLMAP's text and millimetres."""

LEVELS = ("1mm_10deg", "2mm_20deg")
HELD_OUT = slice(7, None, 16)
"""Lights that the fit does not see and that its pictures are compared under."""
COMPARED = AssessOptions(spp=16, relit_size=64, relit_spp=1)


def run_product(*words: object) -> dict[str, Any]:
    """The JSON of one of the product's commands; raises `CommandError` with its message."""
    done = subprocess.run(own_command(*map(str, words), "--json"), capture_output=True, text=True)
    if done.returncode:
        raise CommandError(f"{' '.join(map(str, words))}: {done.stderr[-600:]}", done.returncode)
    return dict(json.loads(done.stdout))


def _scored(capture: Capture, model: Model, truth: StrandTruth, seed: int) -> dict[str, Any]:
    """F in percent over visible and all points, pictures of lights left out, and the warnings."""
    scores = truth.score(model.strands())
    held_out = HeldOut(lights=tuple(capture.olat_lights()[HELD_OUT]))
    fit(capture, model, held_out=held_out, seed=seed)
    pictures = assess(capture, model, held_out=held_out, options=COMPARED, seed=seed)
    report = model.report()
    return {
        **{part: {k: 100 * scores[part][k]["f"] for k in LEVELS} for part in ("visible", "all")},
        "pictures": pictures["held_out_lights"],
        "seconds": sum(stage.seconds for stage in report.stages),
        "warnings": [w for stage in report.stages for w in stage.warnings],
    }


def _imported(
    work: Path, observed: Capture, written: Written, args: argparse.Namespace
) -> tuple[Capture, Model]:
    """The capture written out, imported and reconstructed by the commands."""
    folder = write_folder(observed, work / "folder", written, args.seed)
    run_product("import", folder, "--out", work / "capture")
    model, options = work / "model", json.dumps(_options(args))
    run_product("reconstruct", work / "capture", "--out", model, "--options", options)
    return Capture(work / "capture"), Model(model)


def _options(args: argparse.Namespace) -> dict[str, Any]:
    return {"grid": 4e-3, "roots": 300} if args.quick else {"grid": 3e-3, "roots": 3000}


def _shot(args: argparse.Namespace, progress: Progress) -> tuple[Capture, Path]:
    """What every row sees, and the truth's folder."""
    if args.quick:
        framing = replace(FRAMINGS["curly"], rows=21, coarser=6)
        made, cameras, every = subject_capture("curly", framing, args.cache, 0.0), 4, 1
    else:
        made, cameras, every = demo_capture(args.seed), 6, 5
    path, truth = made.make(args.cache, progress)
    whole = Capture(path)
    names = [c.name for c in whole.rig.cameras][:cameras]
    return whole.view(cameras=names, lights=whole.olat_lights()[::every]), truth


def run(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """The capture itself, then each damage; see the module's docstring."""
    damages = {k: w for k, w in DAMAGES.items() if args.only in (None, k)}
    if not damages:
        raise LeftOut(f"no damage {args.only!r}; there are {', '.join(DAMAGES)}")
    if args.quick:
        damages = {ALL: DAMAGES[ALL]}
    observed, folder = _shot(args, within(progress, "capture", 0.0, 0.3))
    truth = StrandTruth(observed, folder)
    results: dict[str, Any] = {
        "cameras": len(observed.rig.cameras),
        "lights": len(observed.olat_lights()),
        "rows": {},
    }
    for k, (name, written) in enumerate({"direct": None, **damages}.items()):
        progress(name, 0.3 + 0.7 * k / (len(damages) + 1))
        with tempfile.TemporaryDirectory(dir=args.out) as work:
            if written is None:
                model = Model(Path(work) / "model")
                options = parse_options(ReconstructOptions, _options(args))
                reconstruct(observed, model, method="auto", options=options)
                capture = observed
            else:
                capture, model = _imported(Path(work), observed, written, args)
            results["rows"][name] = _scored(capture, model, truth, args.seed)
        save(args.out / "importing.json", results)
        (args.out / "importing.md").write_text(table(results))
    return results


def table(results: dict[str, Any]) -> str:
    """F at both levels over visible points, what is lost at the finer one, pictures; Markdown."""
    rows, first = [], results["rows"]["direct"]["visible"][LEVELS[0]]
    for name, row in results["rows"].items():
        fine, coarse = (row["visible"][k] for k in LEVELS)
        ours, nearest = (row["pictures"][k]["psnr"] for k in ("ours", "three_nearest"))
        scores = (f"{fine:.1f}", f"{coarse:.1f}", f"{fine - first:+.1f}")
        rows.append((name, *scores, f"{ours:.1f}", f"{nearest:.1f}"))
    head = ("written as", "F at 1 mm/10°, %", "F at 2 mm/20°, %", "points at 1 mm")
    return markdown((*head, "lights left out, dB", "three nearest lights, dB"), rows)


BENCHMARK = Benchmark(run, (CACHE, ONLY))

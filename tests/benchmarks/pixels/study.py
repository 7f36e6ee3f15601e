"""Strands of patches of fine hair at several pixel pitches, by the default options.

Captures go through the wires once and are kept. Leaves `pixels/SUBJECT_PITCH/` with the model and a
picture of its strands beside the truth, `pixels.json` and the table `pixels.md`.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

from appearance.export.resizing import resized
from benchmarks.command import CACHE, ONLY, Benchmark, LeftOut, option, within
from benchmarks.pictures import picture_strands
from benchmarks.pixels.rig import PITCHES, SUBJECTS, TUNING, patch_capture
from benchmarks.results import save
from benchmarks.strand_truth import StrandTruth
from reconstruction import (
    Capture,
    CaptureError,
    Model,
    Progress,
    ReconstructOptions,
    reconstruct,
)
from reconstruction.methods import Method

METHODS: tuple[Method, ...] = ("light_planes", "hull")
AT = ("1mm_10deg", "2mm_20deg", "3mm_30deg")
TANGENTS = ("texture_radius_mm", "radius_mm", "reflection_weight", "line_weight")
SAMPLES = 20_000
HEADER = (
    "| subject | pixel mm | | F at 1 / 2 / 3 mm | precision | recall | F at equal length "
    "| metres over true | strand consistency | CPU s |"
)


def run(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Every subject of `SUBJECTS` at every pitch, by each method, and the baselines."""
    if args.only not in (None, *SUBJECTS):
        raise LeftOut(f"no subject {args.only!r}; there are {', '.join(SUBJECTS)}")
    if not all(PITCHES[-1] / 4 <= 1e-3 * p <= 4 * PITCHES[0] for p in args.pitches):
        raise LeftOut(f"pitches {args.pitches}: expected millimetres from 0.06 to 7")
    names = [n for n in SUBJECTS if args.only in (None, n)]
    pitches = sorted((1e-3 * p for p in args.pitches), reverse=True)
    if args.quick:
        names, pitches = ["wavy"], pitches[:1]
    cells = [(n, p) for n in names for p in pitches]
    results: dict[str, Any] = {"seed": args.seed, "tuned_on": TUNING, "cells": {}}
    for k, (name, pitch) in enumerate(cells):
        label = f"{name}_{pitch * 1e6:.0f}um"
        part = within(progress, label, k / len(cells), 1 / len(cells))
        try:
            results["cells"][label] = _cell(args, name, pitch, part)
        except LeftOut as error:
            results["cells"][label] = {"left_out": str(error)}
        save(args.out / "pixels.json", results)
        (args.out / "pixels.md").write_text(table(results))
    return results


def _cell(args: argparse.Namespace, name: str, pitch: float, progress: Progress) -> dict[str, Any]:
    """The scores of one subject at one pitch, by variant."""
    spp = 1 if args.quick else args.spp
    simulated, ball = patch_capture(name, pitch, args.cache, spp=spp, seed=args.seed)
    folder, truth_folder = simulated.make(args.cache, within(progress, "capture", 0.0, 0.6))
    capture = Capture(folder)
    truth = StrandTruth(capture, truth_folder, ball, SAMPLES)
    options = ReconstructOptions(max_length=SUBJECTS[name].longest, seed=args.seed)
    variants: dict[str, Any] = {}
    out = args.out / "pixels" / f"{name}_{pitch * 1e6:.0f}um"
    for k, method in enumerate(args.methods):
        model = Model(out / method)
        begin = time.perf_counter(), time.process_time()
        part = within(progress, method, 0.6 + 0.3 * k / len(args.methods), 0.3 / len(args.methods))
        try:
            report = reconstruct(
                Capture(folder), model, method=method, options=options, progress=part
            )
        except CaptureError as error:
            variants[method] = {"left_out": str(error)}
            continue
        variants[method] = {
            **truth.score(model.strands()),
            "seconds": time.perf_counter() - begin[0],
            "cpu_seconds": time.process_time() - begin[1],
            "peak_gb": max(s.peak_gb or 0.0 for s in report.stages),
            "stages": {s.name: s.seconds for s in report.stages},
            "scale": report["scale"].figures,
            "tangents": {k: report["orientation"].figures.get(k) for k in TANGENTS},
        }
    done = [m for m in args.methods if "left_out" not in variants[m]]
    if not done:
        return variants
    progress("baselines", 0.95)
    model = Model(out / done[0])
    lengths = variants[done[0]]["lengths"]
    strands, share = model.strands(), lengths["true"]["total_m"] / lengths["pred"]["total_m"]
    if share > 1:
        more, _ = resized(strands, round(share * len(strands)), args.seed)
        variants[f"{done[0]}, strands added up to the true metres"] = truth.score(more)
    variants |= truth.baselines(model)
    # whole: in the ball alone one would look at hair behind what the camera shows
    sets = {"true": truth.whole, "reconstructed": model.strands()}
    picture_strands(out / "strands.png", capture.rig.cameras[0], sets)
    return variants


def table(results: dict[str, Any]) -> str:
    """The cells as a table in Markdown; the visible strands are scored."""
    rows = [HEADER, "|" + " --- |" * 10]
    for label, found in results["cells"].items():
        name, pitch = label.removesuffix("um").rsplit("_", 1)
        variants = {"": found} if "left_out" in found else found
        for variant, score in variants.items():
            if "left_out" in score:
                cells = [name, f"{int(pitch) / 1e3:g}", variant.replace("_", " ")]
                rows.append(f"| {' | '.join(cells)} | left out: {score['left_out']} |" + " |" * 6)
                continue
            visible, equal = score["visible"], score["equal_length"]["visible"]
            lengths = score["lengths"]
            first = visible[AT[0]]
            cpu = score.get("cpu_seconds")
            cells = [
                name + (" (tuned on)" if name == results["tuned_on"] else ""),
                f"{int(pitch) / 1e3:g}",
                variant.replace("_", " "),
                " / ".join(f"{100 * visible[at]['f']:.1f}" for at in AT),
                f"{100 * first['precision']:.1f}",
                f"{100 * first['recall']:.1f}",
                f"{100 * equal[AT[0]]['f']:.1f}",
                f"{lengths['pred']['total_m'] / lengths['true']['total_m']:.2f}",
                f"{score['connectivity']['true']['strand_consistency'][AT[1]]:.2f}",
                "" if cpu is None else f"{cpu:.0f}",
            ]
            rows.append(f"| {' | '.join(cells)} |")
    return "\n".join(rows) + "\n"


PITCH = option(
    "--pitches",
    "millimetres a pixel spans",
    type=float,
    nargs="+",
    default=[1e3 * p for p in PITCHES],
)
METHOD = option("--methods", "of reconstruction", nargs="+", choices=METHODS, default=[*METHODS])
SPP = option("--spp", "paths a pixel of the frames", type=int, default=16)
BENCHMARK = Benchmark(run, (CACHE, ONLY, PITCH, METHOD, SPP))

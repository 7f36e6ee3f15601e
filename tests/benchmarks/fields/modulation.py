"""Fields of reflectance beside their baselines.

On `frames_of` a groom. Frames interpolated on the bent strands are judged on the same pixels.
"brightest" adds what an additive field has from a map's brightest direction alone, with all its
light. Gains over inverse rendering have their standard errors over views and lights. Leaves
`fields.json` and `fields.md`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from appearance.fields.field import Field
from appearance.fields.fit import fit_pictures
from appearance.fields.interpolation import Interpolation
from appearance.fields.options import FieldOptions
from appearance.fields.pictures import Pictures
from appearance.fields.reflectance import CapturedView, ReflectanceField
from appearance.fields.search import searched
from benchmarks.appearance.known_subjects import SmallStage
from benchmarks.command import CAPTURE, SUBJECT, Benchmark, option
from benchmarks.fields.cost import cost
from benchmarks.fields.fitted import captured_of, fitted_frames
from benchmarks.fields.frames import (
    GROUPS,
    HELD_VIEWS,
    MAPPED,
    Frames,
    Pair,
    frames_of,
    summed,
    under_maps,
)
from benchmarks.results import markdown, save, spread
from benchmarks.subjects import Subject, simulated
from reconstruction import Progress, silent
from reconstruction.arrays import Array

STAGE = SmallStage(size=24, cameras=8, lights=18, spp=576, max_depth=6, truth=(12, 48, 48))
BRIGHTEST = "maps, brightest"
BASELINE: dict[str, Any] = {
    "degree": 3,
    "iterations": 12,
    "folds": 2,
    "ridges": (0.01, 0.1, 1.0),
}
"""Sixteen times the coefficients of degree 1 take few ridges and folds, or an hour."""
FIELDS = {
    "GaussianHair's: dual harmonics of the whole picture, degree 3": FieldOptions(
        "whole", **BASELINE
    ),
    "additive (GroomLight's), degree 3": FieldOptions("additive", **BASELINE),
    "modulation, degree 0": FieldOptions("modulation", degree=0),
    "modulation, degree 1": FieldOptions("modulation"),
    "modulation, degree 2": FieldOptions("modulation", degree=2),
}
SIZES = {"full": STAGE, "quick": SmallStage(12, cameras=4, lights=8, spp=16, max_depth=3)}


def interpolated(frames: Frames, progress: Progress) -> dict[str, dict[str, float]]:
    """Rows of interpolated frames: three nearest lights, standard, and guided (Photobooth §4)."""
    lights = frames.pictures[0].lights
    kept = [i for i in range(len(lights)) if i not in frames.held_lights]
    own = [k for k in range(len(frames.pictures)) if k not in frames.held_views]
    observed = [frames.pictures[k] for k in own]
    tables = [p.captured[kept].astype(np.float16) for p in observed]
    cameras = zip(observed, tables, strict=True)
    views = tuple(CapturedView(p.hits.camera, p.hits.pixels, t) for p, t in cameras)
    field = ReflectanceField(tuple(lights[i] for i in kept), views, 1.0)
    standard = Interpolation.of(field, frames.mapped, frames.strands)
    names = [light.name for light in field.lights]
    guide = searched(standard, names[1::3], cameras=1, progress=progress)
    rows = {}
    towards = np.array([x.position / np.linalg.norm(x.position) for x in lights])
    cosine = np.clip(towards @ towards[kept].T, -1, 1)
    order = np.argsort(-cosine, axis=1)[:, :3]
    weights = 1 / np.maximum(np.arccos(np.take_along_axis(cosine, order, axis=1)), 1e-6)
    weights /= weights.sum(axis=1, keepdims=True)
    near = {}
    for k, table in zip(own, tables, strict=True):
        mixed = np.einsum("ln,lnpc->lpc", weights, table[order].astype(float))
        near[k] = mixed, mixed
    rows["three nearest lights"] = frames.psnr(near)
    for name, one in (
        ("standard interpolation (Photobooth's)", standard),
        ("model-based interpolation (Photobooth's)", replace(standard, model=guide.best)),
    ):
        lit = {}
        for k, p in enumerate(frames.pictures):
            hits = one.sources[own.index(k)].hits if k in own else p.hits
            made = one.at_hits(hits).under(lights)[0]
            lit[k] = made, made
        rows[name] = frames.psnr(lit)
    return rows


def in_brightest(frames: Frames, field: Field, k: int, weights: Array) -> Pair:
    """View k with the field's response to the brightest light, for the light of all of them."""
    view = frames.pictures[k]
    at, light = field.at(view.hits), view.lights[int(np.argmax(weights))]
    one, other = summed(frames.rendered[k], weights)
    response = at.response(light)
    if not at.additive:
        return one * np.maximum(1 + response, 0), other * np.maximum(1 + response, 0)
    given = sum(w * at.irradiance(x) for w, x in zip(weights, view.lights, strict=True))
    if at.alone:
        return np.maximum(response * given, 0), np.maximum(response * given, 0)
    return np.maximum(one + response * given, 0), np.maximum(other + response * given, 0)


def rows_of(
    frames: Frames, fields: Mapping[str, FieldOptions], progress: Progress
) -> dict[str, Any]:
    """PSNR by group of every row of the table, and what the fits took."""
    training = frames.training()
    colour = np.mean([p.captured.mean(axis=(0, 1)) for p in training], axis=0)
    flat = {k: (np.broadcast_to(colour, t[0].shape),) * 2 for k, t in enumerate(frames.true)}
    rows: dict[str, Any] = {
        "mean colour": frames.psnr(flat),
        "inverse rendering": frames.psnr(dict(enumerate(frames.rendered))),
        **interpolated(frames, progress),
    }
    for name, options in fields.items():
        progress(name, 0.5)
        rows[name] = row_of(frames, training, options)
    return rows


def row_of(frames: Frames, training: Sequence[Pictures], options: FieldOptions) -> dict[str, Any]:
    """What a field fitted to `training` is worth, whether or not the fit keeps it."""
    begun = time.process_time()
    found = fit_pictures(training, frames.places, frames.scale, options)
    seconds = time.process_time() - begun
    lit = {}
    for k, p in enumerate(frames.pictures):
        at = found.field.at(p.hits)
        one, other = (at.lit(x.astype(np.float32), p.lights) for x in frames.rendered[k])
        lit[k] = one, other
    return {
        **frames.psnr(lit),
        "gains": frames.gains(lit),
        BRIGHTEST: under_maps(frames, partial(in_brightest, frames, found.field)),
        "cpu_seconds": seconds,
        "ridge": found.ridge,
        "clamped": found.clamped,
        "decision": found.decision.to_dict(),
        "kept": found.decision.kept,
        "warnings": found.warnings,
    }


def run_bench(
    out: Path,
    subjects: Sequence[Subject],
    rig: SmallStage = STAGE,
    *,
    seed: int = 0,
    fields: Mapping[str, FieldOptions] = FIELDS,
    progress: Progress = silent,
) -> dict[str, Any]:
    """The table of `fields`, a seed for each of `subjects`."""
    result: dict[str, Any] = {"rig": asdict(rig), "seeds": []}
    for k, subject in enumerate(subjects):
        progress(f"seed {seed + k}: frames", k / len(subjects))
        begun = time.process_time()
        frames = frames_of(subject, rig, seed + k)
        made = time.process_time() - begun
        result["seeds"].append(
            {"frames_cpu_seconds": made, "rows": rows_of(frames, fields, progress)}
        )
        save(out / "fields.json", result)
    (out / "fields.md").write_text(report(result))
    return result


def run_fitted(
    args: argparse.Namespace, fields: Mapping[str, FieldOptions], progress: Progress
) -> dict[str, Any]:
    """The table of `fields` on top of a fit of captured frames, of one seed."""
    captured, strands = captured_of(args)
    frames, found = fitted_frames(captured, strands, seed=args.seed, progress=progress)
    result = {"seeds": [{"fit": found, "rows": rows_of(frames, fields, progress)}]}
    save(args.out / "fields.json", result)
    (args.out / "fields.md").write_text(report(result))
    return result


def against_views(
    frames: Frames, counts: Sequence[int], fields: Mapping[str, FieldOptions], progress: Progress
) -> dict[str, Any]:
    """Gains over inverse rendering of fits to so many of the training views, evenly chosen."""
    training, found = frames.training(), {}
    for count in counts:
        progress(f"{count} views", 0.5)
        few = [training[k * len(training) // count] for k in range(count)]
        found[str(count)] = {name: row_of(frames, few, x) for name, x in fields.items()}
    return found


def report(result: Mapping[str, Any]) -> str:
    """The tables, for people."""
    seeds = [s["rows"] for s in result["seeds"]]
    lines = []
    for name in seeds[0]:
        cells = []
        for group in (*GROUPS, MAPPED, BRIGHTEST, "cpu_seconds"):
            values = [rows[name][group] for rows in seeds if group in rows[name]]
            found = spread(values) if values else {}
            sd = f" ± {found['sd']:.2f}" if "sd" in found else ""
            cells.append(f"{found['mean']:.2f}{sd}" if values else "")
        cells += [_gains([rows[name]["gains"] for rows in seeds if "gains" in rows[name]])]
        kept = [rows[name]["kept"] for rows in seeds if "kept" in rows[name]]
        lines.append([name, *cells, f"{sum(kept)} of {len(kept)}" if kept else ""])
    heads = ["model", *GROUPS, MAPPED, BRIGHTEST, "fit, CPU s", "gains", "kept"]
    return markdown(heads, lines) + "\n"


def _gains(seeds: Sequence[Mapping[str, Mapping[str, float]]]) -> str:
    """The mean gains of the groups, and the standard errors of these means."""
    return " / ".join(
        f"{np.mean([x[g]['gain'] for x in seeds]):+.1f} ± "
        f"{np.sqrt(np.sum([x[g]['spread'] ** 2 for x in seeds])) / len(seeds):.1f}"
        for g in GROUPS
        if seeds and all(g in x for x in seeds)
    )


def _bench(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    if args.cost:
        result = cost(tuple(args.cost), args.out, args.seed, progress)
        save(args.out / "fields_cost.json", result)
        return result
    fields = {name: FIELDS[name] for name in args.only or FIELDS}
    if args.on != BENT:
        return run_fitted(args, fields, progress)
    rig = SIZES["quick"] if args.quick else STAGE
    if args.views:
        rig = replace(rig, cameras=max(args.views) + len(HELD_VIEWS))
        subject = simulated(args.rig, args.subject, args.head, args.seed)
        frames = frames_of(subject, rig, args.seed)
        result = against_views(frames, args.views, fields, progress)
        save(args.out / "fields_views.json", result)
        return result
    count = 1 if args.quick else args.seeds
    subjects = [simulated(args.rig, args.subject, args.head, args.seed + k) for k in range(count)]
    return run_bench(args.out, subjects, rig, seed=args.seed, fields=fields, progress=progress)


BENT = "bent"
SEEDS = option("--seeds", "of the table", type=int, default=3)
ONLY = option(
    "--only", "of the fields, by name: all unless given", nargs="+", choices=tuple(FIELDS)
)
COST = option(
    "--cost",
    "only what a whole fit to synthetic pictures takes: hair pixels a view, views, lights",
    type=int,
    nargs=3,
)
VIEWS = option("--views", "only gains against so many training views", type=int, nargs="+")
ON = option(
    "--on",
    "bent strands, inverse rendering emulated; or inverse rendering of the subject's frames on "
    "reconstructed --strands; or of Cycles' on its true or given --strands: one seed",
    choices=(BENT, "reconstructed", "cycles"),
    default=BENT,
)
STRANDS = option("--strands", "those of a reconstruction, for --on", type=Path)
BENCHMARK = Benchmark(_bench, (*SUBJECT, SEEDS, ONLY, COST, VIEWS, ON, STRANDS, CAPTURE))

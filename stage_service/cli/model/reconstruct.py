"""`hairstage reconstruct`: strands from a capture."""

from __future__ import annotations

import argparse
import os
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from reconstruction.methods import METHODS
from stage_service.cli.support.commands import (
    BadArgument,
    Commands,
    Output,
    add_command,
    add_frame,
    add_view,
    progress_bar,
    read_json,
)

if TYPE_CHECKING:
    from reconstruction import Capture
    from reconstruction.estimate import Estimate
    from stage_service.jobs.records import JobOptions

MEMORY_SHARE = 0.8  # of this machine's memory; above it, a larger --reduce is suggested


def add(commands: Commands) -> None:
    """Add the command."""
    remains = "the same command begins anew"
    reconstruct = add_command(commands, "reconstruct", run, interrupted=remains, renders=True)
    reconstruct.add_argument("capture", type=Path)
    reconstruct.add_argument("--method", choices=METHODS, default="auto")
    reconstruct.add_argument("--out", type=Path, help="model folder")
    reconstruct.add_argument(
        "--estimate",
        action="store_true",
        help="only estimate seconds, memory and disk on this machine",
    )
    add_frame(reconstruct)
    reconstruct.add_argument("--options", help="the method's options as JSON")
    add_view(reconstruct)


def run(args: argparse.Namespace, output: Output) -> None:
    """Reconstruct strands from a capture.

    --method auto selects the method by the capture: planes of light if there is a sweep, else the
    hull of the masks, filled along directions from OLAT frames or photographs under constant light.

    Write MODEL/strands.npz, .hair and .usdc, MODEL/report.json and the page MODEL/index.html. With
    --estimate, print seconds, memory and disk by stage instead: frames and filters are timed for
    some seconds, the rest is a table scaled by this machine's speed.
    """
    from reconstruction import Capture, Model, parse_options
    from stage_service.jobs.records import JobOptions
    from stage_service.jobs.steps import StepContext, reconstruct
    from stage_service.model_page import write_page

    given = {
        "method": args.method,
        "held_out_cameras": args.hold_out_camera,
        "held_out_lights": args.hold_out_light,
        "reduced": args.reduce,
        "reconstruct": {"frame": args.frame, **read_json(args.options)},
    }
    options, capture = parse_options(JobOptions, given), Capture(args.capture)
    if args.estimate:
        _estimate(capture, options, output)
        return
    if args.out is None:
        raise BadArgument("give --out MODEL, or --estimate")
    _check_folder(args.out)
    model = Model(args.out)
    with progress_bar("reconstruct") as progress:
        reconstruct(StepContext(args.capture, model, options, progress))
    write_page(model)
    strands = model.strands()
    seconds = sum(stage.seconds for stage in model.report().stages)
    chosen = next((s.figures for s in model.report().stages if s.name == "method"), None)
    method = chosen["method"] if chosen else args.method
    data = {"model": str(model), "strands": len(strands), "points": len(strands.points)}
    if chosen:
        output.note(f"{chosen['capture_holds']}: method {method}")
    for stage in model.report().stages:
        for warning in stage.warnings:
            output.note(f"warning: {stage.name}: {warning}")
    output.result(
        {**data, "method": method, "seconds": seconds},
        f"{len(strands)} strands in {model.file('strands.npz')} ({seconds:.0f} s)",
    )


def _check_folder(out: Path) -> None:
    """Raise `BadArgument` if files of others are in `out`: a model removes those with its names."""
    if out.exists() and not out.is_dir():
        raise BadArgument(f"--out {out} is a file: a model is a folder")
    there = {p.name for p in out.iterdir() if p.name[0] != "."} if out.exists() else set()
    if there & {"rig.json", "cameras.json"}:
        raise BadArgument(
            f"--out {out} is a capture or a folder to import, whose head would be removed: "
            "choose a "
            "new folder"
        )
    if there and not there & {"masks", "strands.npz", "report.json", "work"}:
        raise BadArgument(
            f"--out {out} has files that are no model's, and a model may replace them: choose a "
            "new "
            "folder"
        )


def _estimate(capture: Capture, options: JobOptions, output: Output) -> None:
    """Print the estimated cost of reconstructing `capture`."""
    from reconstruction.estimate import estimate

    cost_options = replace(
        options.reconstruct, held_out=options.held_out_cameras, seed=options.seed
    )
    capture, by = capture.without_lights(options.held_out_lights), options.reduced
    machine_gb = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9

    def tried(by: int) -> Estimate:
        with progress_bar("estimate") as progress:
            view = capture.view(reduced=by)
            return estimate(view, method=options.method, options=cost_options, progress=progress)

    found = tried(by)
    lines = [f"{'stage':<14}{'seconds':>9}{'memory':>11}  measured here"]
    lines += [
        f"{s.name:<14}{s.seconds:9.0f}{s.peak_gb:8.1f} GB{s.measured:8.0%}" for s in found.stages
    ]
    temporary = f", {found.working_gb:.1f} GB more temporarily" if found.working_gb else ""
    lines.append(
        f"{_duration(found.seconds)} in all, {found.peak_gb:.1f} GB of this machine's "
        f"{machine_gb:.0f}; {found.frames:,} frames are read, the model takes {found.disk_gb:.1f} "
        f"GB of disk{temporary}. Estimates are usually within a third on an idle machine."
    )
    resolution = found.scale.resolution
    lines.append(f"{resolution[0].upper()}{resolution[1:]}.")
    data = {"reduced": by, "method": found.method, **asdict(found), "seconds": found.seconds}
    if found.peak_gb > MEMORY_SHARE * machine_gb:
        for by in (n for n in (2, 4, 8, 16) if n > options.reduced):
            if (less := tried(by)).peak_gb < MEMORY_SHARE * machine_gb:
                data["fits"] = {"reduced": by, "seconds": less.seconds, "peak_gb": less.peak_gb}
                lines.append(
                    f"That exceeds the memory of this machine: --reduce {by} takes "
                    f"{_duration(less.seconds)} and {less.peak_gb:.1f} GB."
                )
                break
    output.result({**data, "peak_gb": found.peak_gb, "machine_gb": machine_gb}, "\n".join(lines))


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"

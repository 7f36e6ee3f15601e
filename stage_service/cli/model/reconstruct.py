"""`hairstage reconstruct`: strands from a capture, without a service."""

from __future__ import annotations

import argparse
from pathlib import Path

from reconstruction.methods import METHODS
from stage_service.cli.support.commands import (
    Commands,
    Output,
    add_command,
    add_held_out,
    progress_bar,
    read_json,
)


def add(commands: Commands) -> None:
    """Add the command."""
    reconstruct = add_command(commands, "reconstruct", run)
    reconstruct.add_argument("capture", type=Path)
    reconstruct.add_argument("--method", choices=METHODS, default="auto")
    reconstruct.add_argument("--out", type=Path, required=True, help="model folder")
    reconstruct.add_argument("--options", help="the method's options as JSON")
    add_held_out(reconstruct)


def run(args: argparse.Namespace, output: Output) -> None:
    """Strands from a capture.

    --method auto takes what the capture holds, and says what it is: planes of light where there is
    a sweep, else the masks' hull, filled along what single lights show.

    Write MODEL/strands.npz, .hair and .usdc, MODEL/report.json, and a page on them,
    MODEL/index.html.
    """
    from reconstruction import Capture, Model, parse_options
    from stage_service.jobs.records import JobOptions
    from stage_service.jobs.steps import StepContext, reconstruct
    from stage_service.model_page import write_page

    asked = {
        "method": args.method,
        "held_out_cameras": args.hold_out_camera,
        "held_out_lights": args.hold_out_light,
        "reconstruct": read_json(args.options),
    }
    options, model = parse_options(JobOptions, asked), Model(args.out)
    Capture(args.capture)
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

"""`hairstage reconstruct`: strands from a capture, without a service."""

from __future__ import annotations

import argparse
from pathlib import Path

from reconstruction.methods import METHODS
from stage_service.cli.support import (
    Commands,
    Output,
    add_command,
    add_held_out,
    progress_bar,
    read_json,
)


def add(commands: Commands) -> None:
    """Add the command."""
    reconstruct = add_command(
        commands,
        "reconstruct",
        run,
        "strands from a capture",
        "Write MODEL/strands.npz, .hair and .usdc, and MODEL/report.json.",
    )
    reconstruct.add_argument("capture", type=Path)
    reconstruct.add_argument("--method", choices=METHODS, default="light_planes")
    reconstruct.add_argument("--out", type=Path, required=True, help="model folder")
    reconstruct.add_argument("--options", help="the method's options as JSON")
    add_held_out(reconstruct)


def run(args: argparse.Namespace, output: Output) -> int:
    """Reconstruct strands."""
    from reconstruction.capture.folder import Capture
    from reconstruction.files.strands import read_strands
    from reconstruction.report.report import Report
    from stage_service.jobs.records import JobOptions
    from stage_service.jobs.steps import StepContext, reconstruct

    options = JobOptions(
        method=args.method,
        held_out_cameras=tuple(args.hold_out_camera),
        held_out_lights=tuple(args.hold_out_light),
        reconstruct=read_json(args.options),
    )
    Capture(args.capture)
    args.out.mkdir(parents=True, exist_ok=True)
    with progress_bar("reconstruct") as progress:
        reconstruct(StepContext(args.capture, args.out, options, progress))
    strands = read_strands(args.out / "strands.npz")
    seconds = sum(stage.seconds for stage in Report.load(args.out / "report.json").stages)
    data = {"model": str(args.out), "strands": len(strands), "points": len(strands.points)}
    output.result(
        {**data, "seconds": seconds},
        f"{len(strands)} strands in {args.out / 'strands.npz'} ({seconds:.0f} s)",
    )
    return 0

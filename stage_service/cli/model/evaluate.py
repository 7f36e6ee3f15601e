"""`hairstage evaluate`: scores against the truth."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from stage_service.cli.support.commands import (
    BadArgument,
    Commands,
    Output,
    add_command,
    add_frame,
    add_group,
    progress_bar,
)


def add(commands: Commands) -> None:
    """Add the commands."""
    group = add_group(commands, "evaluate", "score results against the truth")
    geometry = add_command(group, "geometry", run_geometry)
    geometry.add_argument("pred", type=Path, help="strand file")
    geometry.add_argument("true", type=Path, help="strand file")
    geometry.add_argument("--capture", type=Path, help="capture, for its cameras and head")
    geometry.add_argument("--head", type=Path, help="head mesh (OBJ), instead of the capture's")
    add_frame(geometry)
    geometry.add_argument("--out", type=Path, help="folder for report.json and pictures")
    geometry.add_argument("--seed", type=int, default=0)


def run_geometry(args: argparse.Namespace, output: Output) -> None:
    """Precision, recall and F of strands against true ones.

    Compare two strand files (metres, z up, roots first; of an imported capture, in the frame and
    unit of its cameras) at 1 mm/10°, 2 mm/20° and 3 mm/30°: over all true points, and with
    --capture over the visible ones; with and without the direction from root to tip; with lengths
    and continuity. With --capture also the scores with the true directions over a pixel.
    """
    from reconstruction import Capture, Model, read_obj, read_strands
    from reconstruction.evaluation.assessment import assess_strands, input_warnings
    from stage_service.cli.support.tables import assessment_text

    if args.seed < 0:
        raise BadArgument(f"--seed {args.seed}: expected 0 or more")
    if args.out is not None and any((args.out / f).exists() for f in ("strands.npz", "rig.json")):
        raise BadArgument(
            f"--out {args.out} is a model or a capture, whose report.json would be replaced: "
            "choose another folder"
        )
    capture = Capture(args.capture) if args.capture is not None else None
    world = Model(args.pred.parent).frame if capture is None else capture.world
    world = None if args.frame == "stage" else world
    pred, true = (read_strands(path, frame=world) for path in (args.pred, args.true))
    if not len(true):
        raise BadArgument(f"{args.true}: no strands to compare with")
    head = capture.head if capture is not None else None
    if args.head is not None:
        head = read_obj(args.head) if world is None else world.inputs(read_obj(args.head))
    early = input_warnings(pred, true)
    for warning in early:  # before the work: strands in millimetres take long
        output.note(f"warning: {warning}")
    with progress_bar("evaluate") as progress:
        assessment = assess_strands(
            pred,
            true,
            cameras=capture.rig.cameras if capture is not None else None,
            head=head,
            seed=args.seed,
            progress=progress,
        )
    figures = assessment.figures
    if args.out is not None:
        from reconstruction.evaluation.error_pictures import draw_errors
        from reconstruction.files.durable import write_whole

        pictures = draw_errors(assessment, args.out)
        figures = {**figures, "pictures": [str(p) for p in pictures]}
        report = json.dumps(figures, indent=1, allow_nan=False) + "\n"
        write_whole(args.out / "report.json", report.encode())
    for warning in figures["warnings"]:
        if warning not in early:
            output.note(f"warning: {warning}")
    output.result(figures, assessment_text(figures))

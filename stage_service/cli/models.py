"""`reconstruct`, `fit` and `render`: models on disk, without a service."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from reconstruction.methods import METHODS
from stage_service.cli.support import (
    BadInput,
    Commands,
    Output,
    add_command,
    progress_bar,
)

FIT_METHODS = ("sun", "inverse_rendering")


def add(commands: Commands) -> None:
    """Add the commands."""
    reconstruct = add_command(
        commands,
        "reconstruct",
        run_reconstruct,
        "strands from a capture",
        "Write MODEL/strands.npz, .hair and .usdc, and MODEL/report.json.",
    )
    reconstruct.add_argument("capture", type=Path)
    reconstruct.add_argument("--method", choices=METHODS, default="light_planes")
    reconstruct.add_argument("--out", type=Path, required=True, help="model folder")
    reconstruct.add_argument("--options", help="the method's options as JSON")
    _held_out(reconstruct)

    fit = add_command(
        commands,
        "fit",
        run_fit,
        "the hair's appearance from a capture and its strands",
        "Write MODEL/appearance.json: roughness and colour of hair and skin (method sun). "
        "inverse_rendering goes on from there, with a sun fit first where there is none: hair that "
        "varies over the scalp and along strands, and the lights as they are found, in "
        "MODEL/hair_maps.npz and lights.json; stopped, it goes on where it was. With held-out "
        "cameras or lights, judge the model on them.",
    )
    fit.add_argument("capture", type=Path)
    fit.add_argument("model", type=Path, help="model folder with strands.npz")
    fit.add_argument("--method", choices=FIT_METHODS, default="sun")
    fit.add_argument("--options", help="the method's options as JSON")
    _held_out(fit)
    fit.add_argument("--environment", default="studio", help="studio, sky, or an .hdr or .exr file")
    fit.add_argument("--seed", type=int, default=0)

    render = add_command(
        commands,
        "render",
        run_render,
        "a model under an environment map, or lights of its rig",
        "Render MODEL's strands with its fitted appearance (its hair maps and the lights as found, "
        "where there are any), in the pose of its capture.",
    )
    render.add_argument("model", type=Path)
    render.add_argument("--capture", type=Path, help="the capture that gives rig and head")
    render.add_argument("--camera", help="a camera of the rig, instead of a three-quarter view")
    render.add_argument(
        "--light",
        action="append",
        default=[],
        help="a light of the rig (repeat for more); the environment is then dark unless given",
    )
    render.add_argument(
        "--environment", help="studio (where nothing else is given), sky, or an .hdr or .exr file"
    )
    render.add_argument("--out", type=Path, help=".png (exposed, sRGB) or .exr (linear)")
    render.add_argument("--spp", type=int, default=64, help="samples a pixel")
    render.add_argument("--seed", type=int, default=0)


def run_reconstruct(args: argparse.Namespace, output: Output) -> int:
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
        reconstruct=_json(args.options),
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


def run_fit(args: argparse.Namespace, output: Output) -> int:
    """Fit the appearance."""
    from reconstruction.model import Model
    from reconstruction.options import parse_options
    from stage_service.jobs.records import JobOptions
    from stage_service.jobs.steps import StepContext, assess, fit, inverse_rendering

    model, inverse = Model(args.model), args.method == "inverse_rendering"
    asked = {
        "held_out_cameras": args.hold_out_camera,
        "held_out_lights": args.hold_out_light,
        "environment": args.environment,
        "seed": args.seed,
        "inverse_rendering" if inverse else "fit": _json(args.options),
    }
    options = parse_options(JobOptions, asked)
    data: dict[str, Any] = {"model": str(model), "method": args.method}
    if not inverse or not model.has("appearance.json"):
        with progress_bar("sun") as progress:
            fit(StepContext(args.capture, args.model, options, progress))
    if inverse:
        with progress_bar("inverse") as progress:
            data |= inverse_rendering(StepContext(args.capture, args.model, options, progress))
    data["appearance"] = model.json("appearance.json")
    if options.held_out_cameras or options.held_out_lights:
        with progress_bar("assess") as progress:
            data["images"] = assess(StepContext(args.capture, args.model, options, progress))
    output.result(data)
    return 0


def run_render(args: argparse.Namespace, output: Output) -> int:
    """Render a model."""
    from stage_service.cli.rendering import render_model

    with progress_bar("render") as progress:
        done = render_model(args, progress)
    output.result(done, f"{done['image']} ({done['camera']}, {done['seconds']:.0f} s)")
    return 0


def _held_out(parser: argparse.ArgumentParser) -> None:
    for kind in ("camera", "light"):
        parser.add_argument(
            f"--hold-out-{kind}",
            action="append",
            default=[],
            metavar=kind.upper(),
            help=f"a {kind} to leave out, to judge the result on (repeat for more)",
        )


def _json(text: str | None) -> dict[str, Any]:
    try:
        value = json.loads(text or "{}")
    except json.JSONDecodeError as error:
        raise BadInput(f"--options is not JSON: {error}") from error
    if not isinstance(value, dict):
        raise BadInput(f"--options must be a JSON object, got {text}")
    return value

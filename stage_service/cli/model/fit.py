"""`hairstage fit`: fit the appearance of a capture and its strands."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from reconstruction.deprecated import new_name
from stage_service.cli.support.commands import (
    BadArgument,
    Commands,
    Output,
    add_command,
    add_view,
    progress_bar,
    read_json,
)

if TYPE_CHECKING:
    from reconstruction import Capture, Model
    from stage_service.jobs.records import JobOptions


def add(commands: Commands) -> None:
    """Add the command."""
    remains = "the same command resumes inverse rendering and fields, and begins a sun fit anew"
    fit = add_command(commands, "fit", run, interrupted=remains, renders=True)
    fit.add_argument("capture", type=Path)
    fit.add_argument("model", type=Path, help="model folder with strands.npz")
    fit.add_argument(
        "--stages",
        type=_stage_names,
        help="only some of sun, shared, spatial, correctives, lights, field, separated by commas; "
        "default: all",
    )
    fit.add_argument(
        "--estimate", action="store_true", help="only estimate seconds and memory of each stage"
    )
    fit.add_argument("--options", help="options of fit, inverse_rendering and fields as JSON")
    fit.add_argument("--method", choices=("sun", "inverse_rendering"), help=argparse.SUPPRESS)
    fit.add_argument("--field", choices=("none", "modulation", "additive"), help=argparse.SUPPRESS)
    fit.add_argument("--field-options", help=argparse.SUPPRESS)
    add_view(fit)
    fit.add_argument(
        "--environment",
        default="studio",
        help="environment of the relit image, if cameras or lights are held out: studio, sky, or "
        "an .hdr or .exr file",
    )
    fit.add_argument("--seed", type=int, default=0)


def _stage_names(text: str) -> list[str]:
    from appearance.metrics.decision import STAGES

    names = text.split(",")
    for name in names:
        if name not in STAGES:
            raise argparse.ArgumentTypeError(
                f"{name!r} is no stage: name some of {','.join(STAGES)}"
            )
    return names


def run(args: argparse.Namespace, output: Output) -> None:
    """Fit the hair's appearance from a capture and its strands.

    Stages in order: sun (roughness and colour from highlights, MODEL/appearance.json), shared
    (both by rendering), spatial (colour over the scalp and along strands), correctives (rotations
    of the fibres), lights (their intensities, axes and lobes; MODEL/hair_maps.npz and lights.json),
    and field (the reflectance that the material lacks; MODEL/field.npz). Each after the first is
    kept if it lowers the error on frames that took no part by more than its standard error.
    --stages without sun uses an existing sun fit that held out the same. Held-out cameras and
    lights score the model.
    """
    from appearance.render.environment_maps import environment_map
    from reconstruction import Capture, Model, parse_options
    from stage_service.jobs.records import JobOptions
    from stage_service.jobs.steps import STEPS, StepContext
    from stage_service.model_page import write_page

    model = Model(args.model)
    given = {
        "held_out_cameras": args.hold_out_camera,
        "held_out_lights": args.hold_out_light,
        "reduced": args.reduce,
        "environment": args.environment,
        "seed": args.seed,
        **_stages(args),
    }
    options = parse_options(JobOptions, given)
    environment_map(options.environment)  # fail before the work
    if args.estimate:
        _estimate(Capture(args.capture).view(reduced=args.reduce), model, options, output)
        return
    data: dict[str, Any] = {"model": str(model), "stages": []}

    def step(name: str) -> dict[str, Any]:
        with progress_bar(name.split("_")[0]) as progress:
            return STEPS[name](StepContext(args.capture, model, options, progress))

    for name in ("fit", "inverse_rendering", "fields"):
        found = step(name)
        if name == "fields" and "field" in options.stages and "left_out" in found:
            output.note(f"field: {found['left_out']}")
        data |= {} if "left_out" in found else {name: found}
        for stage in found.get("stages", ()):
            output.note(stage["line"])
            data["stages"].append(stage)
    data["appearance"] = model.json("appearance.json")
    if options.held_out_cameras or options.held_out_lights:
        step("relight")
        data["images"] = step("assess")
    write_page(model)
    data["warnings"] = [f"{s.name}: {w}" for s in model.report().stages for w in s.warnings]
    for warning in data["warnings"]:
        output.note(f"warning: {warning}")
    output.result(data)


def _estimate(capture: Capture, model: Model, options: JobOptions, output: Output) -> None:
    """Print the estimated cost of each stage."""
    from appearance import HeldOut, estimate_fit

    costs = estimate_fit(
        capture,
        model,
        held_out=HeldOut(options.held_out_cameras, options.held_out_lights),
        stages=options.stages,
        sun=options.fit,
        request=options.inverse_rendering,
        field=options.fields,
    )
    lines = [f"{x.name:<12}{x.seconds:8.0f} s{x.peak_gb:8.1f} GB" for x in costs]
    total = sum(x.seconds for x in costs)
    lines.append(f"{total:.0f} s in all on this machine when idle, without reading frames.")
    output.result({"stages": [asdict(x) for x in costs], "seconds": total}, "\n".join(lines))


def _stages(args: argparse.Namespace) -> dict[str, Any]:
    """The job's options by those of the command, old ones too."""
    given, stages = read_json(args.options), args.stages
    if args.method:
        new_name("hairstage fit", "--method")
        inverse = args.method == "inverse_rendering"
        stages = stages or ["shared" if inverse else "sun"]
        given = {"inverse_rendering" if inverse else "fit": given}
    elif given and not given.keys() & {"fit", "inverse_rendering", "fields"}:
        given = {"fit": given}  # as without --method before 0.2
    if args.field_options and args.field in (None, "none"):
        raise BadArgument("--field-options needs --field")
    if args.field:
        new_name("hairstage fit", "--field")
        stages = [*(stages or ()), "field"]
        of_field = read_json(args.field_options)
        if "field" in of_field:
            raise BadArgument("--field-options may not set field: use --field")
        given["fields"] = {**of_field, "field": args.field}
    return {**given, "stages": stages} if stages else given

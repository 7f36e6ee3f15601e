"""`hairstage fit`: fit the appearance of a capture and its strands."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from stage_service.cli.support.commands import (
    BadArgument,
    Commands,
    Output,
    add_command,
    add_view,
    progress_bar,
    read_json,
)

METHODS = ("sun", "inverse_rendering")
FIELDS = ("none", "modulation", "additive")


def add(commands: Commands) -> None:
    """Add the command."""
    remains = "the same command resumes inverse_rendering and fields, and begins a sun fit anew"
    fit = add_command(commands, "fit", run, interrupted=remains)
    fit.add_argument("capture", type=Path)
    fit.add_argument("model", type=Path, help="model folder with strands.npz")
    fit.add_argument("--method", choices=METHODS, default="sun")
    fit.add_argument("--options", help="the method's options as JSON")
    fit.add_argument(
        "--field",
        choices=FIELDS,
        help="also fit a field of reflectance over the material: a smooth factor on its radiance "
        "(modulation) or radiance added to it (additive); none removes it",
    )
    fit.add_argument("--field-options", help="the field's options as JSON")
    add_view(fit)
    fit.add_argument(
        "--environment",
        default="studio",
        help="environment of the relit image, if cameras or lights are held out: studio, sky, or "
        "an .hdr or .exr file",
    )
    fit.add_argument("--seed", type=int, default=0)


def run(args: argparse.Namespace, output: Output) -> None:
    """Fit the hair's appearance from a capture and its strands.

    Write MODEL/appearance.json: roughness and colour of hair and skin (method sun).
    inverse_rendering starts from a sun fit, which is made first if none held out the same cameras
    and lights. It estimates roughness and colour by rendering: uniform or, with --options '{"fit":
    {"variant": "lights"}}', over the scalp and along strands, together with the lights, in
    MODEL/hair_maps.npz and lights.json. An interrupted run is resumed. --field writes
    MODEL/field.npz, the reflectance that the material lacks; an existing fit is used if it held out
    the same and --options is not given. Held-out cameras and lights are used to score the model.
    """
    from appearance import HeldOut
    from appearance.render.environment_maps import environment_map
    from appearance.sun_fit.fitted_appearance import FittedAppearance
    from reconstruction import Model, parse_options
    from stage_service.jobs.records import JobOptions
    from stage_service.jobs.steps import (
        StepContext,
        assess,
        fields,
        fit,
        inverse_rendering,
        relight,
    )
    from stage_service.model_page import write_page

    if args.field_options and args.field in (None, "none"):
        raise BadArgument("--field-options needs --field")
    of_field = read_json(args.field_options)
    if "field" in of_field:
        raise BadArgument("--field-options may not set field: use --field")
    of_method = read_json(args.options)
    model, inverse = Model(args.model), args.method == "inverse_rendering"
    given = {
        "held_out_cameras": args.hold_out_camera,
        "held_out_lights": args.hold_out_light,
        "reduced": args.reduce,
        "environment": args.environment,
        "seed": args.seed,
        "inverse_rendering" if inverse else "fit": of_method,
        "fields": {"field": args.field or "none", **of_field},
    }
    options = parse_options(JobOptions, given)
    environment_map(options.environment)  # fail before the work
    data: dict[str, Any] = {"model": str(model), "method": args.method}
    held_out = HeldOut(options.held_out_cameras, options.held_out_lights)
    there = FittedAppearance.is_of(model, held_out)
    if not (there and (inverse or (args.field and not of_method))):
        with progress_bar("sun") as progress:
            fit(StepContext(args.capture, model, options, progress))
    if inverse:
        with progress_bar("inverse") as progress:
            data |= inverse_rendering(StepContext(args.capture, model, options, progress))
    if args.field:
        with progress_bar("field") as progress:
            context = StepContext(args.capture, model, options, progress)
            data["field"] = fields(context)
    data["appearance"] = model.json("appearance.json")
    if options.held_out_cameras or options.held_out_lights:
        with progress_bar("assess") as progress:
            context = StepContext(args.capture, model, options, progress)
            relight(context)
            data["images"] = assess(context)
    write_page(model)
    data["warnings"] = [f"{s.name}: {w}" for s in model.report().stages for w in s.warnings]
    for warning in data["warnings"]:
        output.note(f"warning: {warning}")
    output.result(data)

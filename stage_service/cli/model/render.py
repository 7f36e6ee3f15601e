"""`hairstage render`: a picture of a model."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stage_service.cli.support.commands import Commands, Output, add_command, progress_bar

if TYPE_CHECKING:
    from appearance.model.interpolated import InterpolationOptions, Pose
    from reconstruction import Camera, Capture, Light, Model, Progress
    from reconstruction.arrays import Floats

FIELDS = ("none", "modulation", "additive", "interpolation")
SIZE = 512
"""Pixels across, where no camera of a rig says."""


def add(commands: Commands) -> None:
    """Add the command."""
    render = add_command(commands, "render", run)
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
    render.add_argument(
        "--out",
        type=Path,
        help=".png (exposed, sRGB) or .exr (linear), instead of MODEL/render.png",
    )
    render.add_argument(
        "--field",
        choices=FIELDS,
        help="show the model with its field of this kind, or without one, or its hair interpolated "
        "between the frames of --capture; default: the model as it is",
    )
    render.add_argument(
        "--guide",
        choices=("kajiya_kay", "none"),
        default="kajiya_kay",
        help="what guides an interpolation; none is the standard one",
    )
    render.add_argument(
        "--refine", action="store_true", help="turn the guide's tangents to each camera's frames"
    )
    render.add_argument(
        "--strands", type=Path, help="a strand file of another pose: the same strands, moved"
    )
    render.add_argument("--spp", type=int, default=64, help="samples a pixel")
    render.add_argument("--seed", type=int, default=0)


def run(args: argparse.Namespace, output: Output) -> None:
    """A model under an environment map, or lights of its rig.

    Render MODEL's strands with its fitted appearance (its hair maps and the lights as found, where
    there are any), in the pose of its capture or of other --strands. With a field, its hair is what
    the capture's frames say of it.
    """
    with progress_bar("render") as progress:
        done = _render(args, progress)
    for warning in done["warnings"]:
        output.note(f"warning: {warning}")
    output.result(done, f"{done['image']} ({done['camera']}, {done['seconds']:.0f} s)")


def _render(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Render what was asked for; returns what was written."""
    from appearance import Environment, FittedModel, Sampling, render_mixed
    from appearance.model.interpolated import InterpolationOptions, Pose, all_lights
    from appearance.model.relight import environment_map, three_quarter_view
    from reconstruction import Capture, Model, read_strands
    from reconstruction.files.durable import writing
    from stage_service.model_page import write_page

    start = time.perf_counter()
    if args.out is not None and args.out.suffix not in (".png", ".exr"):
        raise ValueError(f"--out {args.out}: expected .png or .exr")
    if args.seed < 0:
        raise ValueError(f"--seed {args.seed}: expected 0 or more")
    capture = Capture(args.capture) if args.capture is not None else None
    if capture is None and (args.camera is not None or args.light):
        raise ValueError("--camera and --light name parts of a rig: say whose with --capture")
    if capture is None and args.field == "interpolation":
        raise ValueError("--field interpolation needs the frames: say whose with --capture")
    progress("building the scene", 0.0)
    model = Model(args.model)
    of_model = None if args.field == "interpolation" else args.field
    fitted = FittedModel.load(model, capture).with_field_of(model, of_model)
    pose = Pose(fitted, read_strands(args.strands) if args.strands is not None else None)
    camera = three_quarter_view(fitted.strands, SIZE)
    if capture is not None and args.camera is not None:
        camera = capture.rig.camera(args.camera)
    environment = args.environment or (None if args.light else "studio")
    maps = [] if environment is None else [Environment(environment_map(environment))]
    lights = fitted.lights(args.light) if args.light else []
    progress("rendering", 0.2)
    sampling = Sampling(args.spp, seed=args.seed)
    image = render_mixed(fitted.scene(pose.strands), camera, lights, maps, sampling)
    found: dict[str, Any] = {"warnings": []}
    if capture is not None and args.field == "interpolation":
        lit = camera, all_lights(lights, maps)
        options = InterpolationOptions(guide=args.guide, refine=args.refine)
        image, found = _interpolated(image, options, (pose, model, capture), lit, progress)
    out: Path = args.out or model.file("render.png")
    with writing(out) as part:
        _write(part, image)
    if args.out is None:
        write_page(model)
    progress("written", 1.0)
    return {
        "image": str(out),
        "camera": camera.name,
        "lights": args.light,
        "environment": environment,
        "field": "none" if fitted.field is None else fitted.field.kind,
        **found,
        "seconds": time.perf_counter() - start,
    }


def _interpolated(
    image: Floats,
    options: InterpolationOptions,
    whose: tuple[Pose, Model, Capture],
    lit: tuple[Camera, Sequence[Light]],
    progress: Progress,
) -> tuple[Floats, dict[str, Any]]:
    """The picture with its hair from captured frames, and what there is to tell of it."""
    from appearance.model.interpolated import interpolation_of, with_samples
    from reconstruction import Stage

    pose, model, capture = whose
    stage = Stage("interpolation")
    interpolation = interpolation_of(
        pose.fitted,
        model,
        capture,
        stage=stage,
        options=options,
        progress=lambda what, share: progress(what, 0.5 + 0.4 * share),
    )
    image, told = with_samples(image, interpolation, pose, *lit)
    if told["hair_unseen"] > 0.01:
        stage.warn(f"{told['hair_unseen']:.0%} of the hair was seen by no camera: it is rendered")
    return image, {
        **told,
        "field": "interpolation",
        "guide": stage.figures,
        "warnings": stage.warnings,
    }


def _write(out: Path, image: Floats) -> None:
    from appearance import Exposure
    from appearance.metrics.pictures import write_png
    from appearance.metrics.scores import srgb
    from reconstruction import write_exr

    if out.suffix == ".exr":
        write_exr(out, image)
    else:
        lit = image[image.sum(axis=-1) > 0]
        write_png(out, srgb(image) if not len(lit) else Exposure.of([lit])(image))

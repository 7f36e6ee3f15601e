"""`hairstage render`: a picture of a model."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stage_service.cli.support.commands import Commands, Output, add_command, progress_bar

if TYPE_CHECKING:
    from reconstruction import Progress
    from reconstruction.arrays import Floats

FIELDS = ("none", "modulation", "additive")
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
        help="show the model with its field of this kind, or without one; default: as it is",
    )
    render.add_argument("--spp", type=int, default=64, help="samples a pixel")
    render.add_argument("--seed", type=int, default=0)


def run(args: argparse.Namespace, output: Output) -> None:
    """A model under an environment map, or lights of its rig.

    Render MODEL's strands with its fitted appearance (its hair maps and the lights as found, where
    there are any), in the pose of its capture.
    """
    with progress_bar("render") as progress:
        done = _render(args, progress)
    output.result(done, f"{done['image']} ({done['camera']}, {done['seconds']:.0f} s)")


def _render(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Render what was asked for; returns what was written."""
    from appearance import Environment, FittedModel, Sampling
    from appearance.model.relight import environment_map, three_quarter_view
    from reconstruction import Capture, Model
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
    progress("building the scene", 0.0)
    model = Model(args.model)
    fitted = FittedModel.load(model, capture).with_field_of(model, args.field)
    camera = three_quarter_view(fitted.strands, SIZE)
    if capture is not None and args.camera is not None:
        camera = capture.rig.camera(args.camera)
    environment = args.environment or (None if args.light else "studio")
    maps = [] if environment is None else [Environment(environment_map(environment))]
    lights = fitted.lights(args.light) if args.light else []
    progress("rendering", 0.2)
    image = fitted.render(camera, lights, maps, Sampling(args.spp, seed=args.seed))
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
        "seconds": time.perf_counter() - start,
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

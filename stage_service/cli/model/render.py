"""`hairstage render`: a picture of a model."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stage_service.cli.support.commands import Commands, Output, add_command, progress_bar

if TYPE_CHECKING:
    from appearance import Environment, FittedModel, Sampling
    from appearance.model.interpolated import InterpolationOptions, Pose
    from reconstruction import Camera, Capture, Light, Model, Progress, Strands
    from reconstruction.arrays import Floats

FIELDS = ("none", "interpolation")
SIZE, FILM_SIZE = 512, 192
"""Pixels across of a picture and of an animation, where no camera of a rig says."""
MOST_SIZE = 16_384
SPP, FILM_SPP = 64, 6
FRAMES = 24


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
        help=".png (exposed, sRGB) or .exr (linear), instead of MODEL/render.png; .webp of an "
        "animation, instead of MODEL/render.webp",
    )
    render.add_argument(
        "--field",
        choices=FIELDS,
        help="none: without the model's field; interpolation: the hair interpolated between the "
        "frames of --capture; default: the model with its field, if it has one",
    )
    render.add_argument(
        "--guide",
        choices=("kajiya_kay", "none", "model"),
        help="what guides an interpolation, kajiya_kay where nothing is said; none is the standard "
        "one; model, for a camera of the capture, is what our own renders say",
    )
    render.add_argument(
        "--refine", action="store_true", help="turn the guide's tangents to each camera's frames"
    )
    render.add_argument(
        "--strands",
        type=Path,
        help="a strand file of another pose: the same strands, moved; an .npz of poses (T, N, 3) "
        "becomes an animation",
    )
    moves = render.add_mutually_exclusive_group()
    moves.add_argument(
        "--turntable", action="store_true", help="an animation: the model and the room turn"
    )
    moves.add_argument(
        "--turning-light",
        action="store_true",
        help="an animation: the environment turns, the model stays",
    )
    moves.add_argument(
        "--sway", type=float, metavar="DEGREES", help="an animation: the hair swings, at the tips"
    )
    render.add_argument("--frames", type=int, help=f"of an animation; default: {FRAMES}")
    render.add_argument("--size", type=int, help="pixels across, where no --camera says")
    render.add_argument(
        "--spp", type=int, help="samples a pixel; default: 64, in an animation 6, smoothed"
    )
    render.add_argument("--seed", type=int, default=0)


def run(args: argparse.Namespace, output: Output) -> None:
    """A model under an environment map, or lights of its rig.

    Render MODEL's strands with its fitted appearance (its hair maps and the lights as found, where
    there are any), in the pose of its capture or of other --strands. With a field, its hair is what
    the capture's frames say of it. A turntable, light that turns, hair that sways, or strands of
    several poses become a WebP animation, their indirect light smoothed.
    """
    with progress_bar("render") as progress:
        done = _render(args, progress)
    for warning in done["warnings"]:
        output.note(f"warning: {warning}")
    output.result(done, f"{done['image']} ({done['camera']}, {done['seconds']:.0f} s)")


def _render(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Render what was asked for; returns what was written."""
    from appearance import Environment, FittedModel, Sampling
    from appearance.model.relight import environment_map, three_quarter_view
    from reconstruction import Capture, Model
    from reconstruction.files.durable import writing
    from reconstruction.files.strands import read_poses
    from stage_service.model_page import write_page

    start = time.perf_counter()
    if args.seed < 0:
        raise ValueError(f"--seed {args.seed}: expected 0 or more")
    if args.spp is not None and args.spp < 1:
        raise ValueError(f"--spp {args.spp}: expected 1 or more")
    if (args.guide or args.refine) and args.field != "interpolation":
        raise ValueError("--guide and --refine go with --field interpolation")
    if args.refine and args.guide in ("none", "model"):
        raise ValueError(f"--refine turns kajiya_kay's tangents, not those of --guide {args.guide}")
    only_lights = args.light and args.environment is None and args.strands is None
    if args.guide == "model" and not (only_lights and args.camera):
        raise ValueError("--guide model: for a --camera of the capture, its pose and --light")
    if args.size is not None and args.camera is not None:
        raise ValueError("--size: a --camera's pictures have its own size: leave out one of them")
    if args.size is not None and not 16 <= args.size <= MOST_SIZE:
        raise ValueError(f"--size {args.size}: expected 16 to {MOST_SIZE}")
    capture = Capture(args.capture) if args.capture is not None else None
    if capture is None and (args.camera is not None or args.light):
        raise ValueError("--camera and --light name parts of a rig: say whose with --capture")
    if capture is None and args.field == "interpolation":
        raise ValueError("--field interpolation needs the frames: say whose with --capture")
    poses: list[Strands] = [] if args.strands is None else read_poses(args.strands)
    moves = args.turntable or args.turning_light or args.sway is not None or len(poses) > 1
    _check_animation(args, len(poses), moves)
    if args.out is not None:
        args.out.parent.mkdir(parents=True, exist_ok=True)
    progress("building the scene", 0.0)
    model = Model(args.model)
    fitted = FittedModel.load(model, capture, with_field=args.field != "none")
    if capture is not None and args.camera is not None:
        camera = capture.rig.camera(args.camera)
    else:
        camera = three_quarter_view(fitted.strands, args.size or (FILM_SIZE if moves else SIZE))
    environment = args.environment or (None if args.light else "studio")
    maps = [] if environment is None else [Environment(environment_map(environment))]
    lights = fitted.lights(args.light) if args.light else []
    sampling = Sampling(args.spp or (FILM_SPP if moves else SPP), seed=args.seed)
    out: Path = args.out or model.file("render.webp" if moves else "render.png")
    found: dict[str, Any] = {"warnings": []}
    if moves:
        found |= _animate(args, fitted, poses, (camera, lights, maps, sampling), out, progress)
    else:
        whose = fitted, model, capture
        lit = camera, lights, maps, sampling
        image, told = _still(args, whose, poses[0] if poses else None, lit, progress)
        found |= told
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


def _check_animation(args: argparse.Namespace, poses: int, moves: bool) -> None:
    """`ValueError` for options that do not go together."""
    suffixes = (".webp",) if moves else (".png", ".exr")
    if args.out is not None and args.out.suffix not in suffixes:
        what = "an animation" if moves else "a picture"
        raise ValueError(f"--out {args.out}: {what} is {' or '.join(suffixes)}")
    if args.frames is not None and (poses > 1 or not moves):
        raise ValueError("--frames: of --turntable, --turning-light or --sway")
    if not moves:
        return
    if args.field == "interpolation":
        raise ValueError("an animation shows the model or its field, not --field interpolation")
    turns = args.turntable or args.turning_light
    if poses and (turns or args.sway is not None):
        raise ValueError(
            "--strands of other poses goes without --turntable, --turning-light and --sway"
        )
    if turns and (args.light or args.camera):
        raise ValueError(
            "--turntable and --turning-light are under a map: without --light and --camera"
        )
    if args.frames is not None and not 2 <= args.frames <= 1000:
        raise ValueError(f"--frames {args.frames}: expected 2 to 1000")


def _animate(
    args: argparse.Namespace,
    fitted: FittedModel,
    poses: Sequence[Strands],
    lit: tuple[Camera, Sequence[Light], Sequence[Environment], Sampling],
    out: Path,
    progress: Progress,
) -> dict[str, Any]:
    """Write the animation that was asked for; what there is to tell of it."""
    from appearance.model.animation import (
        moving,
        sway,
        turning_light,
        turntable,
        write_animation,
    )

    camera, lights, maps, sampling = lit
    count = args.frames or FRAMES
    if args.turntable or args.turning_light:
        turning = turntable if args.turntable else turning_light
        frames = turning(fitted, maps[0], count, camera.width, sampling, progress)
    else:
        shown = poses or sway(fitted.strands, count, args.sway)
        frames = moving(fitted, shown, camera, (lights, maps), sampling, progress)
    write_animation(out, frames)
    return {"frames": len(frames)}


def _still(
    args: argparse.Namespace,
    whose: tuple[FittedModel, Model, Capture | None],
    strands: Strands | None,
    lit: tuple[Camera, Sequence[Light], Sequence[Environment], Sampling],
    progress: Progress,
) -> tuple[Floats, dict[str, Any]]:
    """One picture, and what there is to tell of it."""
    from appearance import render_mixed
    from appearance.model.interpolated import (
        GuidedFrames,
        InterpolationOptions,
        Pose,
        all_lights,
    )

    fitted, model, capture = whose
    pose = Pose(fitted, strands)
    progress("rendering", 0.2)
    image = render_mixed(fitted.scene(pose.strands), *lit)
    if capture is None or args.field != "interpolation":
        return image, {}
    camera, lights, maps, _ = lit
    if args.guide == "model":
        mask = model.mask(camera.name, "hair", capture)
        guided = GuidedFrames(fitted.scene(), fitted, capture, camera, mask)
        return guided(image, lights), {"field": "interpolation", "guide": "model"}
    options = InterpolationOptions(guide=args.guide or "kajiya_kay", refine=args.refine)
    all_lit = camera, all_lights(lights, maps)
    return _interpolated(image, options, (pose, model, capture), all_lit, progress)


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
    from reconstruction import write_exr

    if out.suffix == ".exr":
        write_exr(out, image)
    else:
        write_png(out, Exposure.of_picture(image)(image))

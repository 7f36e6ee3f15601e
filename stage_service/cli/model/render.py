"""`hairstage render`: a picture of a model."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stage_service.cli.support.commands import Commands, Output, add_command, progress_bar

if TYPE_CHECKING:
    from appearance import Environment, FittedModel, HairScene, Sampling
    from appearance.model.interpolated import InterpolationOptions, Pose
    from reconstruction import Camera, Capture, Light, Model, Progress, Strands
    from reconstruction.arrays import Floats

FIELDS = ("none", "interpolation")
SIZE, FILM_SIZE = 512, 192
"""Width in pixels of an image and of an animation without --camera."""
MOST_SIZE = 16_384
SPP, FILM_SPP, TURNTABLE_SPP = 64, 6, 3
FRAMES = 24


def add(commands: Commands) -> None:
    """Add the command."""
    render = add_command(commands, "render", run, interrupted="no image was written", renders=True)
    render.add_argument("model", type=Path)
    render.add_argument("--capture", type=Path, help="the capture, for its rig and head")
    render.add_argument("--camera", help="a camera of the rig, instead of a three-quarter view")
    render.add_argument(
        "--light",
        action="append",
        default=[],
        help="a light of the rig (repeat for more); without an environment unless one is given",
    )
    render.add_argument(
        "--environment", help="studio (default without --light), sky, or an .hdr or .exr file"
    )
    render.add_argument(
        "--out",
        type=Path,
        help=".png (exposed, sRGB) or .exr (linear), default MODEL/render.png; .webp of an "
        "animation, default MODEL/render.webp",
    )
    render.add_argument(
        "--field",
        choices=FIELDS,
        help="none: without the model's field; interpolation: the hair interpolated between the "
        "frames of --capture; default: the model with its field, if it has one",
    )
    render.add_argument(
        "--guide",
        choices=("kajiya_kay", "none"),
        help="guide of an interpolation; default: kajiya_kay",
    )
    render.add_argument(
        "--from-frames",
        type=Path,
        metavar="CAPTURE",
        help="the hair from this capture's frames as far as they show it, the rest from the model",
    )
    render.add_argument(
        "--strands",
        type=Path,
        help="a strand file of another pose: the same strands, moved; an .npz of poses (T, N, 3) "
        "becomes an animation",
    )
    moves = render.add_mutually_exclusive_group()
    moves.add_argument(
        "--turntable", action="store_true", help="animation: model and environment turn"
    )
    moves.add_argument(
        "--turning-light",
        action="store_true",
        help="animation: the environment turns",
    )
    render.add_argument("--frames", type=int, help=f"frames of an animation; default: {FRAMES}")
    render.add_argument("--size", type=int, help="width in pixels, without --camera")
    render.add_argument(
        "--spp", type=int, help="paths a pixel; default: 64; turntable: 3, animations: 6, smoothed"
    )
    render.add_argument("--seed", type=int, default=0)


def run(args: argparse.Namespace, output: Output) -> None:
    """Render a model under an environment map or lights of its rig.

    Render MODEL's strands with its fitted appearance (hair maps and estimated lights, if it has
    them), in the pose of its capture or of other --strands. --field interpolation interpolates the
    hair between captured frames; --from-frames relights a captured subject. --turntable,
    --turning-light and strands of several poses write a WebP animation with smoothed indirect
    light.
    """
    with progress_bar("render") as progress:
        done = _render(args, progress)
    for warning in done["warnings"]:
        output.note(f"warning: {warning}")
    output.result(done, f"{done['image']} ({done['camera']}, {done['seconds']:.0f} s)")


def _render(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Render the image or animation; returns its path and figures."""
    from appearance import Environment, FittedModel, Sampling
    from appearance.model.relight import three_quarter_view
    from appearance.render.environment_maps import environment_map
    from reconstruction import Capture, Model
    from reconstruction.files.durable import writing
    from reconstruction.files.strands import read_poses
    from stage_service.model_page import write_page

    start = time.perf_counter()
    if args.seed < 0:
        raise ValueError(f"--seed {args.seed}: expected 0 or more")
    if args.spp is not None and args.spp < 1:
        raise ValueError(f"--spp {args.spp}: expected 1 or more")
    if args.guide and args.field != "interpolation":
        raise ValueError("--guide needs --field interpolation")
    if args.from_frames is not None:
        if args.field is not None or args.strands is not None:
            raise ValueError("--from-frames cannot be combined with --field or --strands")
        if args.capture not in (None, args.from_frames):
            raise ValueError(
                "--from-frames and --capture are the same capture: leave out --capture"
            )
        args.capture = args.from_frames
    if args.size is not None and args.camera is not None:
        raise ValueError("--size and --camera exclude each other: leave out one of them")
    if args.size is not None and not 16 <= args.size <= MOST_SIZE:
        raise ValueError(f"--size {args.size}: expected 16 to {MOST_SIZE}")
    capture = Capture(args.capture) if args.capture is not None else None
    if capture is not None and args.from_frames is not None:
        capture = capture.view(undistorted=True)
    if capture is None and (args.camera is not None or args.light):
        raise ValueError("--camera and --light need the rig: give --capture")
    if capture is None and args.field == "interpolation":
        raise ValueError("--field interpolation needs captured frames: give --capture")
    poses: list[Strands] = (
        [] if args.strands is None else read_poses(args.strands, Model(args.model).frame)
    )
    moves = args.turntable or args.turning_light or len(poses) > 1
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
    default = TURNTABLE_SPP if args.turntable else FILM_SPP if moves else SPP
    sampling = Sampling(args.spp or default, seed=args.seed)
    out: Path = args.out or model.file("render.webp" if moves else "render.png")
    found: dict[str, Any] = {"warnings": []}
    if moves:
        found |= _animate(args, fitted, poses, (camera, lights, maps, sampling), out, progress)
    else:
        sources = fitted, model, capture
        lit = camera, lights, maps, sampling
        image, figures = _still(args, sources, poses[0] if poses else None, lit, progress)
        found |= figures
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
    """Raise `ValueError` for options that exclude each other."""
    suffixes = (".webp",) if moves else (".png", ".exr")
    if args.out is not None and args.out.suffix not in suffixes:
        what = "an animation" if moves else "a picture"
        raise ValueError(f"--out {args.out}: {what} is {' or '.join(suffixes)}")
    if args.frames is not None and (poses > 1 or not moves):
        raise ValueError("--frames needs --turntable or --turning-light")
    if not moves:
        return
    if args.field == "interpolation" or args.from_frames is not None:
        raise ValueError("an animation cannot be combined with captured frames")
    turns = args.turntable or args.turning_light
    if poses and turns:
        raise ValueError("--strands cannot be combined with --turntable or --turning-light")
    if turns and (args.light or args.camera):
        raise ValueError(
            "--turntable and --turning-light cannot be combined with --light or --camera"
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
    """Write the animation; returns its figures."""
    from appearance.model.animation import (
        moving,
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
        frames = moving(fitted, poses, camera, (lights, maps), sampling, progress)
    write_animation(out, frames)
    return {"frames": len(frames)}


def _still(
    args: argparse.Namespace,
    sources: tuple[FittedModel, Model, Capture | None],
    strands: Strands | None,
    lit: tuple[Camera, Sequence[Light], Sequence[Environment], Sampling],
    progress: Progress,
) -> tuple[Floats, dict[str, Any]]:
    """One image, and its figures."""
    from appearance import render_mixed
    from appearance.model.interpolated import InterpolationOptions, Pose, all_lights

    fitted, model, capture = sources
    pose = Pose(fitted, strands)
    camera, lights, maps, _ = lit
    scene = fitted.scene(pose.strands)
    if capture is not None and args.from_frames is not None:
        return _from_frames(scene, (fitted, model, capture), lit, progress)
    progress("rendering", 0.2)
    image = render_mixed(scene, *lit)
    if capture is None or args.field != "interpolation":
        return image, {}
    options = InterpolationOptions(guide=args.guide or "kajiya_kay")
    all_lit = camera, all_lights(lights, maps)
    return _interpolated(image, options, (pose, model, capture), all_lit, progress)


def _from_frames(
    scene: HairScene,
    sources: tuple[FittedModel, Model, Capture],
    lit: tuple[Camera, Sequence[Light], Sequence[Environment], Sampling],
    progress: Progress,
) -> tuple[Floats, dict[str, Any]]:
    """The image with its hair relit from frames, and its figures."""
    import numpy as np

    from appearance.model.from_frames import FromFrames, NewViews
    from appearance.model.interpolated import panel
    from appearance.render.smoothed import environment_smoothed, olat_smoothed

    fitted, model, capture = sources
    camera, lights, maps, sampling = lit
    frames = FromFrames.of(
        fitted,
        model,
        capture,
        folder=model.file("samples"),
        progress=lambda what, share: progress(what, 0.4 * share),
    )

    small = [part for light in lights for part in panel(light)] + frames.lights_of(maps)
    rest = [] if maps else frames.some_lights()

    def render(camera: Camera, others: Sequence[Light]) -> Floats:
        progress(f"rendering {camera.name}", 0.6)
        single = olat_smoothed(scene, camera, [*lights, *others], sampling)
        whole = single[: len(lights)].sum(axis=0)
        for one in maps:  # the noise of paths would count as an error of the model
            whole += environment_smoothed(scene, camera, one.shown(), sampling)
        return np.concatenate([whole[None], single[len(lights) :]])

    base, view = render(camera, [])[0], frames.view(camera)
    if view is not None:
        image, unseen = frames.relit(view, small, base)
    else:
        rendered = {v.camera.name: render(v.camera, rest) for v in frames.field.views}
        image, unseen = NewViews.of(frames, [small, *([x] for x in rest)], rendered)(camera, base)
    share = f"{unseen:.0%} of the hair is captured by no camera or saturated: it is rendered"
    warnings = [share] if unseen > 0.01 else []
    return image, {"hair_unseen": unseen, "field": "frames", "warnings": warnings}


def _interpolated(
    image: Floats,
    options: InterpolationOptions,
    sources: tuple[Pose, Model, Capture],
    lit: tuple[Camera, Sequence[Light]],
    progress: Progress,
) -> tuple[Floats, dict[str, Any]]:
    """The image with its hair from captured frames, and its figures."""
    from appearance.model.interpolated import interpolation_of, with_samples
    from reconstruction import Stage

    pose, model, capture = sources
    stage = Stage("interpolation")
    interpolation = interpolation_of(
        pose.fitted,
        model,
        capture,
        stage=stage,
        options=options,
        progress=lambda what, share: progress(what, 0.5 + 0.4 * share),
    )
    image, figures = with_samples(image, interpolation, pose, *lit)
    if figures["hair_unseen"] > 0.01:
        stage.warn(
            f"{figures['hair_unseen']:.0%} of the hair is visible to no camera: it is rendered"
        )
    return image, {
        **figures,
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

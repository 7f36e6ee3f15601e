"""`hairstage export`: convert a model for other programs."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stage_service.cli.support.commands import (
    BadArgument,
    Commands,
    Output,
    add_command,
    add_frame,
)

if TYPE_CHECKING:
    from appearance.export.groom import Groom
    from appearance.export.options import ExportOptions
    from reconstruction import Capture, Mesh, Strands
    from reconstruction.arrays import Ints
    from reconstruction.geometry.world_frame import WorldFrame

USD = (".usd", ".usda", ".usdc")
SUFFIXES = {
    **{"usd": USD, "houdini": USD, "unreal": (".abc",), "abc": (".abc",), "hair": (".hair",)},
    **{"ply": (".ply",), "gltf": (".glb",)},
}
FOLDERS = ("blender", "mitsuba", "maps")
ONLY = {
    "guides": ("usd", "houdini", "unreal", "blender"),
    "cards": ("gltf",),
    "environment": ("mitsuba",),
}
"""Targets that accept these options."""
STRANDS = ("abc", "hair", "ply")
"""Formats of strands alone, without a fit."""
SIZE = 640
"""Width in pixels of a Mitsuba scene's camera without --camera."""

OFF = 0.5
"""Distortion in pixels of Mitsuba's camera from which a warning is printed."""


def add(commands: Commands) -> None:
    """Add the command."""
    export = add_command(commands, "export", run)
    export.add_argument("model", type=Path, help="model folder")
    export.add_argument("--to", choices=(*SUFFIXES, *FOLDERS), required=True)
    export.add_argument(
        "--out", type=Path, required=True, help="file, or folder for formats of several files"
    )
    export.add_argument("--capture", type=Path, help="the capture, for its rig and head")
    export.add_argument(
        "--strands",
        type=int,
        help="export so many: a random subset, or more between them; radii keep the coverage",
    )
    export.add_argument(
        "--guides", type=int, help="number of guide strands, exported separately (default: 0)"
    )
    export.add_argument(
        "--cards", type=int, help="hair cards of gltf's finest level (default: 600)"
    )
    export.add_argument(
        "--collide",
        choices=("count", "push", "cut"),
        help="report hair inside the head; push it out, or cut it",
    )
    export.add_argument("--head", type=Path, help="OBJ for --collide (default: the model's head)")
    add_frame(export)
    export.add_argument("--seed", type=int, default=0)
    export.add_argument("--camera", help="a camera of the rig for mitsuba's view")
    export.add_argument(
        "--environment", help="mitsuba's light: studio (default), sky, .hdr or .exr file"
    )


def run(args: argparse.Namespace, output: Output) -> None:
    """Convert a model for other programs.

    Write MODEL with its fitted material, or in a uniform brown without one. usd: strands, head and
    MaterialX hair, z up; houdini: the same, y up; blender: a folder with a script that makes Hair
    Curves with Principled Hair; unreal: Alembic in centimetres with groom_ attributes; gltf: hair
    cards in three levels of detail; mitsuba: a folder with a scene for stock Mitsuba 3; maps: an
    OpenEXR file for each layer of the hair maps; abc, hair, ply: the strands alone, as Alembic,
    cyHair and PLY. Results of imported captures come in the user's world: usd, abc, hair and ply in
    the unit and axes of the cameras' files, the others in their own.
    """
    from appearance.export.groom import Groom
    from appearance.export.options import ExportOptions
    from appearance.export.resizing import resized
    from reconstruction import Capture, Model, parse_options, read_obj, write_strands
    from reconstruction.model import FILES

    out: Path = args.out
    if args.to in SUFFIXES and out.suffix not in SUFFIXES[args.to]:
        raise BadArgument(
            f"--out {out}: expected a file ending in {' or '.join(SUFFIXES[args.to])}"
        )
    if args.to in FOLDERS and out.is_file():
        raise BadArgument(f"--out {out} is a file: {args.to} makes a folder")
    folder = out if args.to in FOLDERS else out.parent
    if any((folder / name).exists() for name in ("strands.npz", "rig.json")) and (
        args.to in FOLDERS or out.name in FILES
    ):
        raise BadArgument(
            f"--out {out} would replace a file of a model or a capture: choose another folder"
        )
    if args.camera is not None and (args.capture is None or args.to != "mitsuba"):
        raise BadArgument("--camera needs --to mitsuba and --capture")
    for name, takers in ONLY.items():
        if getattr(args, name) is not None and args.to not in takers:
            raise BadArgument(f"--{name} is for --to {' or '.join(takers)}, not {args.to}")
    if args.head is not None and args.collide is None:
        raise BadArgument("--head needs --collide")
    given = {n: getattr(args, n) for n in ("strands", "guides", "cards", "seed")}
    given = {n: value for n, value in given.items() if value is not None}
    options = parse_options(ExportOptions, given, "export")
    model, capture = Model(args.model), Capture(args.capture) if args.capture else None
    world = model.frame or (None if capture is None else capture.world)
    world = None if args.frame == "stage" else world
    moved: tuple[Strands, Ints] | None = None
    figures: dict[str, Any] = {}
    if args.collide is not None:
        head = model.head(capture)
        if args.head is not None:
            head = read_obj(args.head) if world is None else world.inputs(read_obj(args.head))
        strands, ids = resized(model.strands(), options.strands, options.seed)
        options = replace(options, strands=None)
        (strands, of), figures = _collided(strands, head, args, output)
        moved = strands, ids[of]
    if args.to in STRANDS:
        strands = model.strands() if moved is None else moved[0]
        strands, _ = resized(strands, options.strands, options.seed)
        out.parent.mkdir(parents=True, exist_ok=True)
        write_strands(out, strands, world)
        files = [out]
    else:
        groom = Groom.load(model, capture, options, moved)
        if not model.has("appearance.json"):
            output.note(
                f"warning: {model} has no fitted material and is exported in a uniform brown: run "
                "'hairstage fit CAPTURE MODEL' first"
            )
        if model.has("field.npz"):
            output.note(f"warning: exports do not contain the reflectance field of {model}")
        if groom.head is None and args.to != "maps":
            output.note(f"warning: {model} has no head: give the capture that has one (--capture)")
        files = _write(args, output, groom, capture, options, world)
    if world is not None and args.to != "maps":
        raw = args.to == "usd" or args.to in STRANDS
        output.note(f"in the frame of the cameras' files: {(world if raw else world.in_metres)}")
    output.result({"files": [str(f) for f in files], **figures}, "\n".join(str(f) for f in files))


def _collided(
    strands: Strands, head: Mesh | None, args: argparse.Namespace, output: Output
) -> tuple[tuple[Strands, Ints], dict[str, Any]]:
    """The strands after `--collide`, the index of each one's original, and figures to print."""
    from reconstruction.geometry.collisions import Collisions

    if head is None:
        raise BadArgument(
            f"--collide needs a head, which {args.model} lacks: give --head or --capture"
        )
    try:
        found = Collisions(strands, head)
    except ValueError as error:
        raise BadArgument(f"--collide: {args.head or 'the head'}: {error}") from error
    figures = {"inside_head": found.inside.figures()}
    output.note(str(found.inside))
    if edges := found.distance.open_edges:
        output.note(f"the head has {edges} open edges: hair through openings is not inside")
    moved = found.resolved(args.collide)
    if args.collide != "count":
        left = Collisions(moved[0], head).inside
        figures["inside_head_after"] = left.figures()
        output.note(f"after {args.collide}: {left}")
    return moved, figures


def _write(
    args: argparse.Namespace,
    output: Output,
    groom: Groom,
    capture: Capture | None,
    options: ExportOptions,
    world: WorldFrame | None,
) -> list[Path]:
    """Write the file or folder; returns the paths."""
    out: Path = args.out
    out.parent.mkdir(parents=True, exist_ok=True)
    if args.to == "usd":
        from appearance.export.usd import export_usd

        return export_usd(groom, out, world=world)
    groom = groom if world is None else groom.at(world.in_metres)
    if args.to == "houdini":
        from appearance.export.usd import export_usd

        return export_usd(groom, out, up="Y")
    if args.to == "blender":
        from appearance.export.blender import export_blender

        return export_blender(groom, out)
    if args.to == "unreal":
        from appearance.export.unreal import export_unreal

        for note in export_unreal(groom, out):
            output.note(note)
        return [out]
    if args.to == "gltf":
        from appearance.export.cards import export_gltf

        export_gltf(groom, out, options.cards, options.seed)
        return [out]
    if args.to == "maps":
        from appearance.export.maps import export_maps

        return export_maps(groom.maps, out)
    import numpy as np

    from appearance.export.mitsuba import View, export_mitsuba, off_by
    from appearance.model.relight import three_quarter_view
    from appearance.render.environment_maps import environment_map

    if capture is None or args.camera is None:
        camera = three_quarter_view(groom.strands, SIZE)
    else:
        camera = capture.rig.camera(args.camera)
        camera = camera if world is None else camera.moved(np.eye(3), -world.origin)
        if (off := off_by(camera)) > OFF:
            output.note(
                f"warning: {camera.name} has lens distortion or non-square pixels, which Mitsuba's "
                f"camera lacks: images are off by up to {off:.1f} pixels"
            )
    return export_mitsuba(groom, out, View(camera, environment_map(args.environment or "studio")))

"""`hairstage export`: a model for other programs."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from stage_service.cli.support.commands import BadArgument, Commands, Output, add_command

if TYPE_CHECKING:
    from appearance.export.groom import Groom
    from appearance.export.options import ExportOptions
    from reconstruction import Capture

USD = (".usd", ".usda", ".usdc")
SUFFIXES = {
    **{"usd": USD, "houdini": USD, "unreal": (".abc",), "abc": (".abc",), "hair": (".hair",)},
    "gltf": (".glb",),
}
FOLDERS = ("blender", "mitsuba", "maps")
ONLY = {
    "guides": ("usd", "houdini", "unreal", "blender"),
    "cards": ("gltf",),
    "environment": ("mitsuba",),
}
"""What takes these options."""
STRANDS = ("abc", "hair")
"""What holds strands alone and needs no fit."""
SIZE = 640
"""Pixels across of a Mitsuba scene's camera, where no camera of a rig says: relit.png's."""

OFF = 0.5
"""Pixels that a picture of Mitsuba's may be off without a word."""


def add(commands: Commands) -> None:
    """Add the command."""
    export = add_command(commands, "export", run)
    export.add_argument("model", type=Path, help="model folder")
    export.add_argument("--to", choices=(*SUFFIXES, *FOLDERS), required=True)
    export.add_argument("--out", type=Path, required=True, help="file, or folder of several")
    export.add_argument("--capture", type=Path, help="the capture that gives rig and head")
    export.add_argument(
        "--strands", type=int, help="so many, drawn at random, their radius larger to cover as much"
    )
    export.add_argument(
        "--guides", type=int, help="strands that stand for clumps, given apart (default: 0)"
    )
    export.add_argument("--cards", type=int, help="ribbons of gltf's finest level (default: 600)")
    export.add_argument("--seed", type=int, default=0)
    export.add_argument("--camera", help="a camera of the rig for mitsuba's view")
    export.add_argument(
        "--environment", help="mitsuba's light: studio (default), sky, .hdr or .exr file"
    )


def run(args: argparse.Namespace, output: Output) -> None:
    """A model for other programs.

    Write MODEL for others, with its fit, or in an even brown without one. usd: strands, head and
    MaterialX hair, z up; houdini: the same, y up; blender: a folder with a script that makes Hair
    Curves with Principled Hair; unreal: Alembic in centimetres with groom_ attributes; gltf: hair
    cards in three levels of detail; mitsuba: a folder with a scene for stock Mitsuba 3; maps: an
    OpenEXR file for each layer of the hair maps; abc, hair: the strands alone, for the readers of
    Alembic and cyHair.
    """
    from appearance.export.groom import Groom, thinned
    from appearance.export.options import ExportOptions
    from reconstruction import Capture, Model, parse_options, write_strands
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
            f"--out {out} would be among the files of a model or a capture, and take the place of "
            "one: choose another folder"
        )
    if args.camera is not None and (args.capture is None or args.to != "mitsuba"):
        raise BadArgument("--camera is a view for mitsuba, of the rig of --capture")
    for name, takers in ONLY.items():
        if getattr(args, name) is not None and args.to not in takers:
            raise BadArgument(f"--{name} is for --to {' or '.join(takers)}, not {args.to}")
    given = {n: getattr(args, n) for n in ("strands", "guides", "cards", "seed")}
    given = {n: value for n, value in given.items() if value is not None}
    options = parse_options(ExportOptions, given, "export")
    model, capture = Model(args.model), Capture(args.capture) if args.capture else None
    moved = capture.plan.get("import", {}).get("origin") if capture is not None else None
    if moved is not None:
        by = ", ".join(f"{x:g}" for x in moved)
        output.note(f"the capture was moved: add ({by}) m to have all in the world it came from")
    if args.to in STRANDS:
        strands, _ = thinned(model.strands(), options.strands, options.seed)
        out.parent.mkdir(parents=True, exist_ok=True)
        write_strands(out, strands)
        files = [out]
    else:
        groom = Groom.load(model, capture, options)
        if not model.has("appearance.json"):
            output.note(
                f"warning: {model} has no fit: its hair goes out in an even brown; "
                "'hairstage fit CAPTURE MODEL' first measures colour and roughness"
            )
        if model.has("field.npz"):
            output.note(f"warning: {model} renders with a field, of which exports know nothing")
        if groom.head is None and args.to != "maps":
            output.note(f"warning: {model} holds no head: give the capture that has it (--capture)")
        files = _write(args, output, groom, capture, options)
    output.result({"files": [str(f) for f in files]}, "\n".join(str(f) for f in files))


def _write(
    args: argparse.Namespace,
    output: Output,
    groom: Groom,
    capture: Capture | None,
    options: ExportOptions,
) -> list[Path]:
    """Write the file or folder; returns what was written."""
    out: Path = args.out
    out.parent.mkdir(parents=True, exist_ok=True)
    if args.to in ("usd", "houdini"):
        from appearance.export.usd import export_usd

        return export_usd(groom, out, up="Z" if args.to == "usd" else "Y")
    if args.to == "blender":
        from appearance.export.blender import export_blender

        return export_blender(groom, out)
    if args.to == "unreal":
        from appearance.export.unreal import export_unreal

        export_unreal(groom, out)
        return [out]
    if args.to == "gltf":
        from appearance.export.cards import export_gltf

        export_gltf(groom, out, options.cards, options.seed)
        return [out]
    if args.to == "maps":
        from appearance.export.maps import export_maps

        return export_maps(groom.maps, out)
    from appearance.export.mitsuba import View, export_mitsuba, off_by
    from appearance.model.relight import environment_map, three_quarter_view

    if capture is None or args.camera is None:
        camera = three_quarter_view(groom.strands, SIZE)
    else:
        camera = capture.rig.camera(args.camera)
        if (off := off_by(camera)) > OFF:
            output.note(
                f"warning: {camera.name} has a lens, or pixels that are not square: Mitsuba's "
                f"camera has neither, and its pictures are off by up to {off:.1f} pixels"
            )
    return export_mitsuba(groom, out, View(camera, environment_map(args.environment or "studio")))

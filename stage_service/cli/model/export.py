"""`hairstage export`: a fitted model for other programs."""

from __future__ import annotations

import argparse
from pathlib import Path

from stage_service.cli.support.commands import BadArgument, Commands, Output, add_command

SUFFIXES = {"usd": (".usd", ".usda", ".usdc"), "abc": (".abc",), "hair": (".hair",)}
SIZE = 512
"""Pixels across of a Mitsuba scene's camera, where no camera of a rig says."""


def add(commands: Commands) -> None:
    """Add the command."""
    export = add_command(commands, "export", run)
    export.add_argument("model", type=Path, help="fitted model folder")
    export.add_argument("--to", choices=("maps", "mitsuba", *SUFFIXES), required=True)
    export.add_argument("--out", type=Path, required=True, help="file, or folder of several")
    export.add_argument("--capture", type=Path, help="the capture that gives rig and head")
    export.add_argument("--camera", help="a camera of the rig for mitsuba's view")


def run(args: argparse.Namespace, output: Output) -> None:
    """A fitted model for other programs.

    Write MODEL for others. maps: a folder with an OpenEXR file for each layer of the hair maps;
    mitsuba: a folder with a scene for stock Mitsuba 3; usd: strands with the appearance as
    primvars; abc, hair: the strands alone, for Alembic's and cyHair's readers.
    """
    from appearance import FittedModel
    from appearance.model.export import export_maps, export_mitsuba, export_usd
    from appearance.model.relight import three_quarter_view
    from reconstruction import Capture, Model, write_strands
    from reconstruction.files.durable import writing

    out: Path = args.out
    if args.to in SUFFIXES and out.suffix not in SUFFIXES[args.to]:
        raise BadArgument(
            f"--out {out}: expected a file ending in {' or '.join(SUFFIXES[args.to])}"
        )
    if args.camera is not None and (args.capture is None or args.to != "mitsuba"):
        raise BadArgument("--camera is a view for mitsuba, of the rig of --capture")
    model, capture = Model(args.model), Capture(args.capture) if args.capture else None
    files = [out]
    if args.to in ("abc", "hair"):
        write_strands(out, model.strands())
    else:
        fitted = FittedModel.load(model, capture)
        if args.to == "maps":
            files = export_maps(fitted.maps, out)
        elif args.to == "usd":
            with writing(out) as part:
                export_usd(fitted, part)
        else:
            camera = three_quarter_view(fitted.strands, SIZE)
            if capture is not None and args.camera is not None:
                camera = capture.rig.camera(args.camera)
            files = [export_mitsuba(fitted, out, camera)]
    output.result({"files": [str(f) for f in files]}, "\n".join(str(f) for f in files))

"""`verify` and `import`: capture folders on disk."""

from __future__ import annotations

import argparse
from pathlib import Path

from stage_service.cli.support.commands import FAILED, Commands, Output, add_command, progress_bar


def add(commands: Commands) -> None:
    """Add the commands."""
    verify = add_command(commands, "verify", run_verify)
    verify.add_argument("capture", type=Path, help="the capture folder")

    imported = add_command(commands, "import", run_import)
    imported.add_argument("folder", type=Path)
    imported.add_argument("--out", type=Path, required=True, help="new capture folder")
    imported.add_argument(
        "--cameras",
        type=Path,
        help="instead of cameras.json: a COLMAP model's folder, transforms.json",
    )
    imported.add_argument(
        "--lights",
        type=Path,
        help="instead of lights.json: positions or directions in .json, .csv, .npy, .obj",
    )
    imported.add_argument(
        "--light-distance", type=float, help="metres, where the lights are directions"
    )
    unit = "m, cm, mm, inch, or its length in metres"
    imported.add_argument("--unit", type=_unit, default="m", help=f"of --cameras: {unit}")
    imported.add_argument("--light-unit", type=_unit, help=f"of --lights, where it differs: {unit}")
    ups = ("x", "-x", "y", "-y", "z", "-z")
    imported.add_argument("--up", choices=ups, help="axis of the files' world that points up")
    imported.add_argument(
        "--camera-axes",
        choices=("opencv", "opengl"),
        help="where they are not what the format of --cameras says",
    )


def run_verify(args: argparse.Namespace, output: Output) -> int:
    """Re-read a whole capture and list what is wrong with it.

    Re-read every file of a capture against its checksum; exit code 1 when anything is wrong.
    """
    from reconstruction import verify

    with progress_bar("verify") as progress:
        problems = verify(args.capture, progress)
    text = "\n".join(problems) or f"{args.capture} is sound"
    output.result({"capture": str(args.capture), "problems": problems}, text)
    return FAILED if problems else 0


def run_import(args: argparse.Namespace, output: Output) -> None:
    """Turn a folder made elsewhere into a capture.

    Read cameras.json, lights.json, images/<camera>/<light>.exr and masks/<camera>.png.
    """
    from reconstruction import import_folder
    from reconstruction.capture.import_geometry import GeometryFiles, read_geometry
    from reconstruction.options import parse_options

    asked = {f: getattr(args, f) for f in ("cameras", "lights", "light_distance")}
    where = {f: getattr(args, f) for f in ("unit", "light_unit", "up", "camera_axes")}
    files = parse_options(GeometryFiles, {**asked, "placement": where}, "import")
    geometry = read_geometry(files) if args.cameras else None
    for note in geometry.notes if geometry else []:
        output.note(note)
    with progress_bar("import") as progress:
        capture = import_folder(args.folder, args.out, progress, geometry)
    counts = {
        "cameras": len(capture.rig.cameras),
        "lights": len(capture.rig.lights),
        "frames": sum(r.file is not None for r in capture.records.values()),
    }
    text = f"{args.out}: " + ", ".join(f"{n} {what}" for what, n in counts.items())
    notes = geometry.notes if geometry else []
    output.result({"capture": str(args.out), **counts, "notes": notes}, text)


def _unit(text: str) -> str | float:
    """A unit's name, or its length."""
    if text in ("m", "cm", "mm", "inch"):
        return text
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"m, cm, mm, inch or metres, not {text!r}") from None

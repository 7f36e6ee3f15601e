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

    with progress_bar("import") as progress:
        capture = import_folder(args.folder, args.out, progress)
    counts = {
        "cameras": len(capture.rig.cameras),
        "lights": len(capture.rig.lights),
        "frames": sum(r.file is not None for r in capture.records.values()),
    }
    text = f"{args.out}: " + ", ".join(f"{n} {what}" for what, n in counts.items())
    output.result({"capture": str(args.out), **counts}, text)

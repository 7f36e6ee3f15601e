"""`calibrate`: a rig file from captures of a board and of spheres; the board to print."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from stage_service.cli.support.commands import (
    BadArgument,
    Commands,
    Output,
    add_command,
    add_group,
    progress_bar,
    rig_path,
)


def add(commands: Commands) -> None:
    """Add the commands."""
    group = add_group(commands, "calibrate", "calibrate a stage")
    rig = add_command(group, "rig", run_rig)
    rig.add_argument(
        "boards",
        type=Path,
        nargs="+",
        metavar="CAPTURE",
        help="captures of the board, one per pose",
    )
    rig.add_argument(
        "--rig", type=rig_path, help="the nominal rig file (default: the first capture's)"
    )
    rig.add_argument("--out", type=Path, required=True, help="rig file to write (.json)")
    rig.add_argument("--mirror", type=Path, nargs="+", default=[], metavar="CAPTURE")
    rig.add_argument("--diffuse", type=Path, nargs="+", default=[], metavar="CAPTURE")
    rig.add_argument("--mirror-radius-mm", type=float, default=50.0)
    rig.add_argument("--diffuse-radius-mm", type=float, default=50.0)
    rig.add_argument("--diffuse-albedo", type=float, default=0.8, help="scales all lights")
    rig.add_argument(
        "--paper-albedo",
        type=float,
        help="albedo of the board; without it projector intensities stay nominal",
    )
    rig.add_argument("--keep-lens", action="store_true", help="keep the nominal K and distortion")
    rig.add_argument("--truth", type=rig_path, help="a rig file to compare with")
    _board_options(rig)

    board = add_command(group, "board", run_board)
    board.add_argument("out", type=Path, help=".png")
    board.add_argument("--dpi", type=float, default=300.0)
    _board_options(board)


def _board_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--columns", type=int, default=9, help="squares across")
    parser.add_argument("--rows", type=int, default=7, help="squares down")
    parser.add_argument("--square-mm", type=float, default=27.0)
    parser.add_argument("--marker-mm", type=float, default=21.0)
    parser.add_argument("--dictionary", default="DICT_4X4_50", help="OpenCV's name")


def _board(args: argparse.Namespace) -> Any:
    from reconstruction.calibration.boards import Board

    square, marker = args.square_mm * 1e-3, args.marker_mm * 1e-3
    return Board(args.columns, args.rows, square, marker, args.dictionary)


def run_rig(args: argparse.Namespace, output: Output) -> None:
    """Calibrate a rig file from captures of a board and of spheres.

    Cameras (and projectors, if the captures have sweeps) are calibrated from captures of a ChArUco
    board, one per pose, lights from captures of a mirror or diffuse sphere, one per place. Writes a
    rig file with the nominal device tables, and NAME.report.json with deviations and undetermined
    parameters.
    """
    from reconstruction import Capture, Rig
    from reconstruction.calibration.rig_comparison import compare_rigs
    from reconstruction.calibration.solve import TargetCaptures, Targets, calibrate
    from reconstruction.files.durable import write_json
    from stage_service.config import load_rig_file

    if args.out.suffix != ".json":
        raise BadArgument(f"--out must end in .json, got {args.out}")
    truth = None if args.truth is None else Rig.load(args.truth)
    args.out.parent.mkdir(parents=True, exist_ok=True)  # fail before the work
    boards = [Capture(p) for p in args.boards]
    tables: dict[str, Any] = {}
    if args.rig is None:
        nominal = boards[0].rig
    else:
        file = load_rig_file(args.rig)
        nominal = file.rig
        tables = {
            key: table.model_dump(mode="json")
            for key in ("devices", "capture", "safety")
            if (table := getattr(file, key)) is not None
        }
    if truth is not None:
        try:
            compare_rigs(nominal, truth)  # fail before the work
        except KeyError as error:
            raise BadArgument(f"--truth {args.truth}: {error.args[0]}") from error
    targets = Targets(
        _board(args),
        args.paper_albedo,
        args.mirror_radius_mm * 1e-3,
        args.diffuse_radius_mm * 1e-3,
        args.diffuse_albedo,
    )
    with progress_bar("calibrate") as progress:
        rig, report = calibrate(
            nominal,
            TargetCaptures(
                boards,
                [Capture(p) for p in args.mirror],
                [Capture(p) for p in args.diffuse],
            ),
            targets,
            keep_lens=args.keep_lens,
            progress=progress,
        )
    write_json(args.out, {**rig.to_dict(), **tables})
    load_rig_file(args.out)
    report.save(args.out.with_suffix(".report.json"))
    data: dict[str, Any] = {
        "rig": str(args.out),
        "stages": {s.name: s.figures for s in report.stages},
        "warnings": [w for s in report.stages for w in s.warnings],
    }
    if truth is not None:
        data["errors"] = compare_rigs(rig, truth)
    output.result(data)


def run_board(args: argparse.Namespace, output: Output) -> None:
    """Write the board as an image to print."""
    import cv2

    board = _board(args)
    if args.out.suffix != ".png":
        raise BadArgument(f"{args.out}: expected a file ending in .png")
    wide = board.square / 0.0254 * args.dpi
    if not 8 <= wide <= 8192:
        raise BadArgument(f"--dpi {args.dpi}: expected squares of 8 to 8192 pixels, got {wide:g}")
    if not cv2.imwrite(str(args.out), board.picture(round(wide))):
        raise BadArgument(f"{args.out}: cannot be written: check that its folder exists")
    width, height = (1e3 * board.size).tolist()
    output.result(
        {"picture": str(args.out), "width_mm": width, "height_mm": height},
        f"{args.out}: print it {width:g} mm wide and {height:g} mm high, measure a square, and "
        "mount it flat with white around it",
    )

"""`evaluate geometry` and `evaluate images`: results against the truth."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from stage_service.cli.output import (
    BAD_INPUT,
    CommandError,
    Commands,
    Output,
    add_command,
    add_group,
)


def add(commands: Commands) -> None:
    """Add the commands."""
    group = add_group(commands, "evaluate", "compare results with the truth")
    geometry = add_command(
        group,
        "geometry",
        run_geometry,
        "precision, recall and F of strands against true ones",
        "Compare two strand files at 1 mm/10°, 2 mm/20° and 3 mm/30°: over all of the true "
        "strands, and with --capture over those its cameras can see.",
    )
    geometry.add_argument("pred", type=Path, help="strand file")
    geometry.add_argument("true", type=Path, help="strand file")
    geometry.add_argument("--capture", type=Path, help="capture that gives cameras and head")
    geometry.add_argument("--seed", type=int, default=0)

    images = add_command(
        group,
        "images",
        run_images,
        "PSNR and SSIM of pictures against true ones",
        "Compare two pictures, or two folders by file name. EXR files are exposed alike (the 99th "
        "percentile of the true pixels becomes 1) and get the sRGB curve first.",
    )
    images.add_argument("pred", type=Path, help="picture or folder")
    images.add_argument("true", type=Path, help="picture or folder")
    images.add_argument("--mask", type=Path, help="grey picture, half and above counts")


def run_geometry(args: argparse.Namespace, output: Output) -> int:
    """Compare strands."""
    from reconstruction.capture import Capture
    from reconstruction.evaluation import compare_strands
    from reconstruction.strand_files import read_strands

    capture = Capture(args.capture) if args.capture is not None else None
    figures = compare_strands(
        read_strands(args.pred),
        read_strands(args.true),
        cameras=capture.rig.cameras if capture is not None else None,
        head=capture.head if capture is not None else None,
        seed=args.seed,
    )
    output.result(figures, geometry_table({"strands": figures}))
    return 0


def run_images(args: argparse.Namespace, output: Output) -> int:
    """Compare pictures."""
    from stage_service.cli.pictures import compare_pictures, pair_up

    pairs = pair_up(args.pred, args.true)
    if not pairs:
        raise CommandError(
            f"{args.pred} and {args.true} have no file name in common", BAD_INPUT, "BadInput"
        )
    images = {name: compare_pictures(a, b, args.mask) for name, a, b in pairs}
    mean = {
        key: sum(figures[key] for figures in images.values()) / len(images)
        for key in ("psnr", "ssim")
    }
    lines = [f"{n}: {f['psnr']:.2f} dB, SSIM {f['ssim']:.4f}" for n, f in images.items()]
    output.result({**mean, "images": images}, "\n".join(lines))
    return 0


def geometry_table(rows: dict[str, dict[str, Any]]) -> Any:
    """A table of precision, recall and F in per cent, a row for each name in `rows`."""
    from rich.table import Table

    thresholds = ("1mm_10deg", "2mm_20deg", "3mm_30deg")
    heads = [t.replace("mm_", " mm/").replace("deg", "°") for t in thresholds]
    title = "Strands against the true ones: precision / recall / F, %"
    table = Table("strands", "over", *heads, title=title)
    for name, figures in rows.items():
        for over in ("visible", "all"):
            if over in figures:
                cells = [
                    " / ".join(
                        f"{100 * figures[over][t][k]:.1f}" for k in ("precision", "recall", "f")
                    )
                    for t in thresholds
                ]
                table.add_row(name, over, *cells)
    return table

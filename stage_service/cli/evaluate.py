"""`evaluate geometry` and `evaluate images`: results against the truth."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from stage_service.cli.output import (
    BAD_INPUT,
    CommandError,
    Commands,
    Output,
    add_command,
    add_group,
    progress_bar,
)

_THRESHOLDS = ("1mm_10deg", "2mm_20deg", "3mm_30deg")
_HEADS = [t.replace("mm_", " mm/").replace("deg", "°") for t in _THRESHOLDS]


def add(commands: Commands) -> None:
    """Add the commands."""
    group = add_group(commands, "evaluate", "compare results with the truth")
    geometry = add_command(
        group,
        "geometry",
        run_geometry,
        "precision, recall and F of strands against true ones",
        "Compare two strand files (metres, z up, roots first) at 1 mm/10°, 2 mm/20° and 3 mm/30°: "
        "over all of the true strands, and with --capture over those its cameras can see; with and "
        "without their direction from root to tip; by part of the hair; and how long and how whole "
        "the strands are.",
    )
    geometry.add_argument("pred", type=Path, help="strand file")
    geometry.add_argument("true", type=Path, help="strand file")
    geometry.add_argument("--capture", type=Path, help="capture that gives cameras and head")
    geometry.add_argument("--head", type=Path, help="head mesh (OBJ), instead of the capture's")
    geometry.add_argument("--out", type=Path, help="folder for report.json and pictures")
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
    from reconstruction.capture.folder import Capture
    from reconstruction.evaluation.assessment import assess_strands
    from reconstruction.files.strands import read_strands
    from reconstruction.geometry.mesh import read_obj

    pred, true = read_strands(args.pred), read_strands(args.true)
    if not len(true):
        raise CommandError(f"{args.true}: no strands to compare with", BAD_INPUT, "BadInput")
    capture = Capture(args.capture) if args.capture is not None else None
    head = capture.head if capture is not None else None
    with progress_bar("evaluate") as progress:
        assessment = assess_strands(
            pred,
            true,
            cameras=capture.rig.cameras if capture is not None else None,
            head=read_obj(args.head) if args.head is not None else head,
            seed=args.seed,
            progress=progress,
        )
    figures = assessment.figures
    if args.out is not None:
        from reconstruction.evaluation.error_pictures import draw_errors
        from reconstruction.files.durable import write_whole

        pictures = draw_errors(assessment, args.out)
        figures = {**figures, "pictures": [str(p) for p in pictures]}
        report = json.dumps(figures, indent=1, allow_nan=False) + "\n"
        write_whole(args.out / "report.json", report.encode())
    for warning in figures["warnings"]:
        output.note(f"warning: {warning}")
    output.result(figures, assessment_text(figures))
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

    table = Table(
        "strands", "over", *_HEADS, title="Strands against the true ones: precision / recall / F, %"
    )
    for name, figures in rows.items():
        for over in ("visible", "all"):
            if over in figures:
                table.add_row(name, over, *_cells(figures[over]))
    return table


def _cells(scores: dict[str, dict[str, float]]) -> list[str]:
    return [
        " / ".join(f"{100 * scores[t][k]:.1f}" for k in ("precision", "recall", "f"))
        for t in _THRESHOLDS
    ]


def assessment_text(figures: dict[str, Any]) -> Any:
    """Tables of what `assess_strands` found."""
    from rich.console import Group
    from rich.table import Table

    regions = Table("part of the hair", *_HEADS, title="Precision / recall / F by part, %")
    for kind in figures["regions"].values():
        for name, scores in kind.items():
            regions.add_row(name, *_cells(scores))
    more = Table("", "predicted", "true", title="Strands")
    for name, value in _STRAND_ROWS:
        cells = [value(figures, which) for which in ("pred", "true")]
        if any(cells):
            more.add_row(name, *cells)
    table = geometry_table({"as lines": figures, "root to tip": figures["directed"]})
    return Group(table, regions, more)


def _spread(figures: dict[str, Any], *path: str) -> str:
    """Mean and 5 to 95 % of a spread, or nothing where it is missing."""
    for key in path:
        figures = figures.get(key, {})
    if "mean" not in figures:
        return ""
    return f"{figures['mean']:.3g} ({figures['p5']:.3g} to {figures['p95']:.3g})"


def _share(figures: dict[str, Any], *path: str) -> str:
    for key in path[:-1]:
        figures = figures.get(key, {})
    return f"{100 * figures[path[-1]]:.1f}" if path[-1] in figures else ""


_ONE = {"pred": "on_one", "true": "by_one"}
_STRAND_ROWS: list[tuple[str, Callable[[dict[str, Any], str], str]]] = [
    ("strands", lambda f, w: f"{f['lengths'][w]['strands']:,}"),
    ("length, mm: mean (5 to 95 %)", lambda f, w: _spread(f, "lengths", w)),
    ("to the nearest point, mm", lambda f, w: _spread(f, "errors", w, "distance_mm")),
    ("angle to it, degrees", lambda f, w: _spread(f, "errors", w, "angle_deg")),
    ("nearest point runs the other way, %", lambda f, w: _share(f, "errors", w, "reversed")),
    ("most of it on one strand, share", lambda f, w: _spread(f, "connectivity", w, _ONE[w])),
    ("strands that lie along it", lambda f, w: _spread(f, "connectivity", w, "covering")),
    ("fewest that cover what any does", lambda f, w: _spread(f, "connectivity", w, "fragments")),
    ("reach the scalp, %", lambda f, w: _share(f, "roots", w, "rooted")),
    ("with their tip, %", lambda f, w: _share(f, "roots", w, "upside_down")),
]

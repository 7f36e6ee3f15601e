"""`hairstage evaluate`: results against the truth."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from stage_service.cli.support.commands import (
    BadArgument,
    Commands,
    Output,
    add_command,
    add_group,
    progress_bar,
)

_DEMO_FIELDS = ("subject", "seed", "geometry", "baselines", "images", "appearance")


def add(commands: Commands) -> None:
    """Add the commands."""
    group = add_group(commands, "evaluate", "compare results with the truth")
    geometry = add_command(group, "geometry", run_geometry)
    geometry.add_argument("pred", type=Path, help="strand file")
    geometry.add_argument("true", type=Path, help="strand file")
    geometry.add_argument("--capture", type=Path, help="capture that gives cameras and head")
    geometry.add_argument("--head", type=Path, help="head mesh (OBJ), instead of the capture's")
    geometry.add_argument("--out", type=Path, help="folder for report.json and pictures")
    geometry.add_argument("--seed", type=int, default=0)

    images = add_command(group, "images", run_images)
    images.add_argument("pred", type=Path, help="picture or folder")
    images.add_argument("true", type=Path, help="picture or folder")
    images.add_argument("--mask", type=Path, help="grey picture, half and above counts")

    table = add_command(group, "table", run_table)
    table.add_argument("results", type=Path, nargs="+", metavar="RESULTS", help="results.json")
    table.add_argument(
        "--short", action="store_true", help="as the README's: warnings are only counted"
    )


def run_geometry(args: argparse.Namespace, output: Output) -> None:
    """Precision, recall and F of strands against true ones.

    Compare two strand files (metres, z up, roots first) at 1 mm/10°, 2 mm/20° and 3 mm/30°: over
    all of the true strands, and with --capture over those its cameras can see; with and without
    their direction from root to tip; by part of the hair; and how long and how whole the strands
    are. With --capture also what they would score with the true directions over a pixel.
    """
    from reconstruction import Capture, read_obj, read_strands
    from reconstruction.evaluation.assessment import assess_strands, input_warnings
    from stage_service.cli.support.tables import assessment_text

    if args.seed < 0:
        raise BadArgument(f"--seed {args.seed}: expected 0 or more")
    if args.out is not None and any((args.out / f).exists() for f in ("strands.npz", "rig.json")):
        raise BadArgument(
            f"--out {args.out} is a model or a capture: its report.json would be replaced: choose "
            "another folder"
        )
    pred, true = read_strands(args.pred), read_strands(args.true)
    if not len(true):
        raise BadArgument(f"{args.true}: no strands to compare with")
    capture = Capture(args.capture) if args.capture is not None else None
    head = capture.head if capture is not None else None
    told = input_warnings(pred, true)
    for warning in told:  # strands in millimetres take long
        output.note(f"warning: {warning}")
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
        if warning not in told:
            output.note(f"warning: {warning}")
    output.result(figures, assessment_text(figures))


def run_images(args: argparse.Namespace, output: Output) -> None:
    """PSNR and SSIM of pictures against true ones.

    Compare two pictures, or two folders by file name. EXR files are exposed alike (the 99th
    percentile of the true pixels becomes 1) and get the sRGB curve first.
    """
    from stage_service.cli.model.pictures import SUFFIXES, compare_pictures, pair_up

    pairs = pair_up(args.pred, args.true)
    if not pairs:
        raise BadArgument(f"{args.pred} and {args.true} have no file name in common")
    there = [p for f in (args.pred, args.true) if f.is_dir() for p in f.iterdir()]
    pictures = {p.name for p in there if p.suffix.lower() in SUFFIXES}
    alone = sorted(pictures - {name for name, *_ in pairs})
    if alone:
        output.note(
            f"warning: {len(alone)} pictures are in one of the folders alone and left out, the "
            f"first is {alone[0]}"
        )
    images = {name: compare_pictures(a, b, args.mask) for name, a, b in pairs}
    mean = {
        key: sum(figures[key] for figures in images.values()) / len(images)
        for key in ("psnr", "ssim")
    }
    lines = [f"{n}: {f['psnr']:.2f} dB, SSIM {f['ssim']:.4f}" for n, f in images.items()]
    output.result({**mean, "images": images}, "\n".join(lines))


def run_table(args: argparse.Namespace, output: Output) -> None:
    """The README's tables of figures, as Markdown.

    Print a column for each subject of some 'hairstage demo': F of the strands at 1 mm/10° over
    visible and all points beside the baselines, PSNR / SSIM of held-out lights and camera, fitted
    and true roughness, and what the jobs warned of. Of a subject with several seeds the mean ±
    the standard deviation over seeds.
    """
    from stage_service.cli.support.tables import figures_of, markdown_table

    columns = demo_columns(args.results)
    output.result(
        {
            "results": columns,
            "figures": {name: figures_of(results) for name, results in columns.items()},
        },
        markdown_table(columns, short=args.short),
    )


def demo_columns(paths: Sequence[Path]) -> dict[str, list[dict[str, Any]]]:
    """Results of demos by the name of their column: one for each subject, its seeds together.

    Raises `CommandError` for a file that is no demo's.
    """
    by_subject: dict[str, list[tuple[Path, dict[str, Any]]]] = {}
    for path in paths:
        results = _demo_results(path)
        by_subject.setdefault(results["subject"], []).append((path, results))
    columns: dict[str, list[dict[str, Any]]] = {}
    stems = [Path(subject).stem for subject in by_subject]
    for subject, found in by_subject.items():
        if stems.count(Path(subject).stem) == 1:  # strand files by their names
            subject = Path(subject).stem
        seeds = [results["seed"] for _, results in found]
        if len(set(seeds)) == len(seeds):
            many = "s" if len(seeds) > 1 else ""
            name = f"{subject}, seed{many} {', '.join(str(s) for s in sorted(seeds))}"
            columns[name] = [results for _, results in found]
        else:  # versions of one demo, not samples
            for path, results in found:
                columns[f"{subject}, seed {results['seed']} ({path})"] = [results]
    return columns


def _demo_results(path: Path) -> dict[str, Any]:
    from reconstruction.reading import parse_json
    from stage_service.cli.support.tables import figures_of

    try:
        results = parse_json(path.read_bytes())
    except ValueError as e:
        raise BadArgument(f"{path} is not JSON: {e}; give a demo's results.json") from e
    if not isinstance(results, dict):
        raise BadArgument(f"{path} is not a JSON object: not a demo's results.json")
    if absent := [field for field in _DEMO_FIELDS if field not in results]:
        raise BadArgument(f"{path} has no {', '.join(absent)}: not a demo's results.json")
    try:
        figures_of([results])
    except (KeyError, TypeError, AttributeError, ValueError) as e:
        what = f"no {e}" if isinstance(e, KeyError) else f"a figure of another kind ({e})"
        raise BadArgument(f"{path} has {what} where a demo's results.json has one") from e
    return results

"""`verify`, `import`, `demultiplex` and `stabilise`: capture folders on disk."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from stage_service.cli.support.commands import (
    FAILED,
    BadArgument,
    Commands,
    Output,
    add_command,
    progress_bar,
)

if TYPE_CHECKING:
    from reconstruction.capture.import_folder import Import


def add(commands: Commands) -> None:
    """Add the commands."""
    verify = add_command(commands, "verify", run_verify)
    verify.add_argument("capture", type=Path, help="the capture folder")

    remains = "the unfinished capture was removed; the same command begins anew"
    imported = add_command(commands, "import", run_import, interrupted=remains)
    imported.add_argument("folder", type=Path)
    imported.add_argument("--out", type=Path, required=True, help="new capture folder")
    imported.add_argument(
        "--pictures",
        help="paths of the OLAT images: {camera}/{light}.png; default: import.toml's, or "
        "images/{camera}/{light}.*; without {light}: photographs under constant light; with "
        "{pattern}: those under patterns",
    )
    imported.add_argument("--settings", type=Path, help="instead of the folder's import.toml")
    imported.add_argument(
        "--dry-run",
        action="store_true",
        help="only list what would be imported, and draw a contact sheet next to --out",
    )
    imported.add_argument(
        "--targets",
        action="store_true",
        help="with --dry-run: find a chart of 24 colours, a grey ball, and lights by mirror balls; "
        "draw them next to --out, and print their lines for import.toml",
    )
    imported.add_argument(
        "--cameras",
        type=Path,
        help="instead of cameras.json: of COLMAP, nerfstudio, Metashape, OpenCV",
    )
    imported.add_argument(
        "--lights",
        type=Path,
        help="instead of lights.json: positions or directions in .json, .csv, .npy, .mat, .obj",
    )
    imported.add_argument(
        "--patterns",
        type=Path,
        help="instead of patterns.csv: weights of the lights in each pattern, in .csv or .json",
    )
    imported.add_argument(
        "--light-distance", type=float, help="metres; for lights given as directions"
    )
    unit = "m, cm, mm, inch, or its length in metres"
    imported.add_argument("--unit", type=_unit, help=f"of the cameras: {unit}; default: m")
    imported.add_argument("--light-unit", type=_unit, help=f"of the lights, if it differs: {unit}")
    ups = ("x", "-x", "y", "-y", "z", "-z")
    imported.add_argument("--up", choices=ups, help="axis of the files' world that points up")
    imported.add_argument(
        "--camera-axes",
        choices=("opencv", "opengl"),
        help="if they differ from those of the format of --cameras",
    )
    presets = ("faceolat", "humanolat", "openillumination")
    imported.add_argument("--preset", choices=presets, help="layout of this published data set")
    imported.add_argument("--take", help="of --preset faceolat: ID20001")

    single = add_command(commands, "demultiplex", run_demultiplex, interrupted=remains)
    single.add_argument("capture", type=Path, help="the capture of patterns of lights")
    single.add_argument("--out", type=Path, required=True, help="new capture folder")

    steady = add_command(commands, "stabilise", run_stabilise, interrupted=remains)
    steady.add_argument("capture", type=Path, help="the capture of a subject that moved")
    steady.add_argument("--out", type=Path, required=True, help="new capture folder")


def run_verify(args: argparse.Namespace, output: Output) -> int:
    """Read a capture again and list its damaged files.

    Compare every file of a capture with its checksum; exit code 1 if any differs.
    """
    from reconstruction import verify

    if not args.capture.is_dir():
        raise BadArgument(f"{args.capture}: no such folder: name a capture folder")
    with progress_bar("verify") as progress:
        problems = verify(args.capture, progress)
    text = "\n".join(problems) or f"{args.capture}: every file is intact"
    output.result({"capture": str(args.capture), "problems": problems}, text)
    return FAILED if problems else 0


def run_import(args: argparse.Namespace, output: Output) -> None:
    """Make a capture of images from elsewhere.

    Read cameras, lights and masks, and images by the patterns of import.toml.
    """
    from reconstruction.capture.contact_sheet import contact_sheet
    from reconstruction.capture.writer import require_vacant
    from reconstruction.images.faint_parts import faint_warnings
    from reconstruction.images.import_targets import find_targets, write_lights
    from reconstruction.images.scene_checks import check_scene
    from reconstruction.light_planes.stabilising import lit_frames

    if args.targets and not args.dry_run:
        raise BadArgument("--targets needs --dry-run: it only proposes lines for import.toml")
    understood, notes, given = _understood(args)
    notes += understood.response.notes
    for note in notes:
        output.note(note)
    if args.dry_run:
        require_vacant(args.out)
        out = args.out.resolve()  # so that "." has a name
        sheet = out.with_name(f"{out.name}-contact-sheet.png")
        sheet.parent.mkdir(parents=True, exist_ok=True)
        contact_sheet(understood, sheet)
        lines, data = [*understood.summary(), f"{sheet}: contact sheet"], {}
        if args.targets:
            proof = out.with_name(f"{out.name}-targets.png")
            targets = find_targets(understood, proof, given)
            notes += targets.notes
            lines += [*targets.notes, f"{proof}: if its outlines are right, add to import.toml:"]
            lines.append(targets.toml or "nothing")
            data = {"targets": str(proof), "toml": targets.toml, "off_deg": targets.off_deg}
            if not given:
                lamps = out.with_name(f"{out.name}-lights.json")
                count = write_lights(understood, targets.lights, args.light_distance, lamps)
                found = f"{lamps}: {count} lights, for --lights"
                missing = (
                    "no light's distance is determined: give --light-distance, or balls 0.3 m apart"
                )
                lines.append(found if count else missing)
        counts = understood.counts()
        output.result({"sheet": str(sheet), **data, **counts, "notes": notes}, "\n".join(lines))
        return
    with progress_bar("import") as progress:
        capture = understood.write(args.out, progress)
        progress("comparing light positions with images", 1.0)
        doubts = [*check_scene(capture), *faint_warnings(capture)]
    if (lit := len(lit_frames(capture))) > 1:
        doubts.append(
            f"{lit} fully lit frames lie among the single lights: if the subject moved, "
            f"'hairstage stabilise {args.out} --out NEW' takes its motion off"
        )
    for note in doubts:
        output.note(note)
    counts = {
        "cameras": len(capture.rig.cameras),
        "lights": len(capture.rig.lights),
        "frames": sum(r.file is not None for r in capture.records.values()),
        "missing": len(understood.missing),
    }
    text = f"{args.out}: " + ", ".join(f"{n} {what}" for what, n in counts.items())
    output.result({"capture": str(args.out), **counts, "notes": [*notes, *doubts]}, text)


def run_demultiplex(args: argparse.Namespace, output: Output) -> None:
    """Turn a capture of patterns into one of single lights.

    Least squares, where the patterns determine each light; prints how much noise this costs.
    """
    from reconstruction import Capture
    from reconstruction.capture.demultiplexing import demultiplex

    with progress_bar("demultiplex") as progress:
        found = demultiplex(Capture(args.capture), args.out, progress)
    for note in found.notes:
        output.note(f"warning: {note}")
    solution, gains = found.solution, {}
    lines = [
        f"{args.out}: {len(solution.read_gain)} single lights of {len(solution.weights)} patterns"
    ]
    for kind in ("read", "photon"):
        gain = getattr(solution, f"{kind}_gain")
        gains[f"{kind}_noise_gain"] = gain.tolist()
        lines.append(
            f"{kind} noise: {gain.mean():.2f} times a single frame's, at most {gain.max():.2f}"
        )
    lines.append(f"condition number: {solution.condition:.3g}")
    if found.misfit is not None:
        lines.append(f"frames differ from the sums by {found.misfit:.2%}")
    data = {"condition": solution.condition, "misfit": found.misfit, "notes": found.notes, **gains}
    output.result({"capture": str(args.out), **data}, "\n".join(lines))


def run_stabilise(args: argparse.Namespace, output: Output) -> None:
    """Take a subject's motion off single lights, by the fully lit frames among them.

    Prints the motion and its estimated error. Nothing is written if the subject kept still.
    """
    from reconstruction import Capture
    from reconstruction.capture.writer import require_vacant
    from reconstruction.light_planes.stabilising import stabilise

    require_vacant(args.out)
    with progress_bar("stabilise") as progress:
        found = stabilise(Capture(args.capture), args.out, progress)
    for note in found.warnings:
        output.note(f"warning: {note}")
    data = {**found.figures, "summary": found.summary, "warnings": found.warnings}
    output.result({"capture": str(found.capture.path), **data}, found.summary)


def _understood(args: argparse.Namespace) -> tuple[Import, list[str], bool]:
    """The import of the folder, notes for the user, and whether the lights are given."""
    from dataclasses import replace

    import numpy as np

    from reconstruction.capture.import_folder import Import, settings_of
    from reconstruction.capture.import_geometry import GeometryFiles, files_in, read_geometry
    from reconstruction.capture.import_matching import light_names
    from reconstruction.capture.import_tables import own_geometry
    from reconstruction.capture.presets import PresetFiles, mean_light, read_preset, understood
    from reconstruction.geometry.lights import Light
    from reconstruction.geometry.placement import PlacementOptions
    from reconstruction.options import parse_options

    if not args.folder.is_dir():
        raise BadArgument(f"{args.folder}: no such folder: name the folder of the images")
    table = None if args.patterns is None else args.patterns.resolve()
    where = {f: getattr(args, f) for f in ("unit", "light_unit", "up", "camera_axes")}
    given = {f: value for f, value in where.items() if value is not None}
    if args.take is not None and args.preset != "faceolat":
        raise BadArgument("--take needs --preset faceolat")
    for name in ("settings", "pictures", "light_distance") if args.preset else ():
        if getattr(args, name) is not None:
            raise BadArgument(
                f"--{name.replace('_', '-')} cannot be combined with --preset: leave it out"
            )
    if args.preset is not None:
        parse_options(PlacementOptions, given, "import")
        of_set = PresetFiles(args.folder, args.take, args.cameras, args.lights)
        take = read_preset(args.preset, of_set, mean_light, given)
        settings, found = understood(take)
        settings = replace(settings, patterns=table)
        imported = Import.of(args.folder, take.geometry, settings, found)
        return imported, [*take.geometry.notes, *imported.found.notes], True
    settings = settings_of(args.folder, args.settings)
    configured = settings.geometry
    options = {f: getattr(args, f) for f in ("cameras", "lights")}
    options = {f: path.resolve() for f, path in options.items() if path is not None}
    if args.light_distance is not None:
        options["light_distance"] = args.light_distance
    placement = {f: v for f, v in vars(configured.placement).items() if v is not None}
    named = {**vars(configured), **options, "placement": {**placement, **given}}
    files = files_in(args.folder, parse_options(GeometryFiles, named, "import"))
    if files.light_distance is not None and files.lights is None and not args.targets:
        raise BadArgument("--light-distance needs --lights; lights.json has positions")
    if files.cameras or (files.lights and not (args.folder / "cameras.json").is_file()):
        geometry = read_geometry(files)
    else:
        geometry = own_geometry(args.folder, files.placement, files)
    if table is not None:
        settings = replace(settings, patterns=table)
    if args.pictures is not None:
        role = "olat" if "{light}" in args.pictures or geometry.lights else "all_on"
        role = "pattern" if "{pattern}" in args.pictures else role
        patterns = replace(settings.pictures, **{role: args.pictures})
        settings = replace(settings, pictures=patterns)
    have_lights = bool(geometry.lights) or table is not None
    if args.targets and not have_lights:
        cameras = list(geometry.cameras.values())
        names = light_names(args.folder, settings, cameras)
        lights = [Light(n, cameras[0].center, np.ones(3)) for n in names]  # to be found
        geometry = replace(geometry, lights=lights)
    imported = Import.of(args.folder, geometry, settings)
    return imported, [*geometry.notes, *imported.found.notes], have_lights


def _unit(text: str) -> str | float:
    """A unit's name, or its length in metres."""
    if text in ("m", "cm", "mm", "inch"):
        return text
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"m, cm, mm, inch or metres, not {text!r}") from None

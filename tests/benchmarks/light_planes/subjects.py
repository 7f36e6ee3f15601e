"""The light-plane method on three subjects, still and drifting, and the demo's, beside baselines.

Sintel and a ponytail come from the folder of data; curls and the demo's waves are procedural.
Captures go through the wires once and are kept. Leaves `light_planes/SUBJECT/` and
`light_planes.json`.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.captures import Optics, SimulatedCapture, levels, rig_file
from benchmarks.command import CACHE, ONLY, Benchmark, LeftOut, data_folder, option, within
from benchmarks.light_planes.study import PAPER, SubjectCaptures, study
from benchmarks.results import save
from reconstruction import (
    Progress,
    ReconstructOptions,
    Strands,
    read_strands,
    write_obj,
    write_strands,
)
from reconstruction.head.fit import HeadHints, fit_head
from stage_service.cli.support.commands import rig_path

CAMERAS = 8
PROJECTORS = [(180, 15), (300, 35), (60, 15), (0, 45), (120, 35), (240, 15)]
"""Azimuth from the front and elevation in degrees; a rig has the first three, or more."""
WIDTH, HEIGHT, ROWS, LIGHTS = 320, 400, 256, 120
DRIFT_MM = 4.0
_DISTANCE = 0.95


@dataclass(frozen=True)
class Framing:
    """What a camera's picture holds, `width` metres across at the `target`; the longest hair.

    A drifting subject moves every `rows` scanlines, where a tracking frame is shot.
    """

    target: tuple[float, float, float]
    width: float
    longest: float
    rows: int = 128
    coarser: int = 1
    """How many of the usual pixels, rows and lights are one."""


FRAMINGS = {
    "sintel": Framing((0.0, 0.0, -0.025), 0.29, 0.25, 64),
    "ponytail": Framing((0.0, 0.06, -0.06), 0.36, 0.35),
    "curly": Framing((0.0, 0.01, 0.01), 0.31, 0.15),
}


def rig_text(framing: Framing, tracking_every: int = 64, projectors: int = 3) -> str:
    """A rig file: 8 cameras of 320×400 around, every other one raised, projectors of 256 rows."""

    def place(azimuth_deg: float, elevation_deg: float, distance: float) -> list[float]:
        a, e = math.radians(azimuth_deg), math.radians(elevation_deg)
        on_sphere = (math.sin(a) * math.cos(e), -math.cos(a) * math.cos(e), math.sin(e))
        return [distance * x + t for x, t in zip(on_sphere, framing.target, strict=True)]

    width, height, rows = (n // framing.coarser for n in (WIDTH, HEIGHT, ROWS))
    optics = Optics(framing.target, math.degrees(2 * math.atan(framing.width / 2 / _DISTANCE)))
    dome = f"lights = {LIGHTS // framing.coarser}\nradius = 1.2\nlowest_deg = -50.0\n"
    dome += "beside_cameras_at = 0.05"
    cameras = [
        optics.device("cameras", k, place(360 / CAMERAS * k, (8, 30)[k % 2], _DISTANCE))
        + f"width = {width}\nheight = {height}"
        for k in range(CAMERAS)
    ]
    wide = Optics(framing.target, math.degrees(2 * math.atan(0.625 * framing.width / 1.1)))
    sweeping = [
        wide.device("projectors", k, place(azimuth, elevation, 1.1))
        + f"roll_deg = 90.0\nwidth = {rows * 5 // 4}\nheight = {rows}\n"
        "intensity = [20.0, 20.0, 20.0]\nline_sigma = 0.6"
        for k, (azimuth, elevation) in enumerate(PROJECTORS[:projectors])
    ]
    capture = f"tracking_every = {tracking_every}\n" + levels(all_on=0.05)
    return rig_file("light_planes", dome, [*cameras, *sweeping], capture)


def ponytail(source: Path, folder: Path) -> tuple[Path, Path]:
    """AMD's ponytail with its face towards −y, and the generic head fitted under its roots."""
    strands = read_strands(source)
    turn = np.diag([-1.0, -1.0, 1.0]).astype(np.float32)
    strands = Strands(strands.points @ turn, strands.offsets, strands.radius)
    roots = strands.points[strands.offsets[:-1]]
    hair, head = folder / "ponytail.npz", folder / "ponytail_head.obj"
    fit = fit_head(roots, hints=HeadHints(part="scalp"))
    write_strands(hair, strands)
    write_obj(head, fit.mesh)
    return hair, head


def subject_capture(
    name: str,
    framing: Framing,
    cache: Path,
    drift_mm: float,
    spp: int = 16,
    seed: int = 0,
    projectors: int = 3,
) -> SimulatedCapture:
    """The capture of a subject of `FRAMINGS`."""
    subject, head, data = name, None, data_folder() or Path()
    if name == "sintel":
        subject, head = (str(data / "sintel" / f) for f in ("sintel.npz", "sintel_head.obj"))
    elif name == "ponytail":
        made = cache / "ponytail"
        if not (made / "ponytail_head.obj").is_file():
            made.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=made) as folder:
                for file in ponytail(data / "ponytail" / "ponytail.npz", Path(folder)):
                    file.replace(made / file.name)
        subject, head = (str(made / f) for f in ("ponytail.npz", "ponytail_head.obj"))
    label = f"{name}-{'still' if drift_mm == 0 else 'drifting'}"
    tracking = framing.rows if drift_mm > 0 else 64 // framing.coarser
    rig = rig_text(framing, tracking, projectors)
    return SimulatedCapture(label, rig, subject, head, drift_mm, spp, seed)


def demo_capture(seed: int = 0) -> SimulatedCapture:
    """That of `make demo`."""
    return SimulatedCapture("demo", rig_path("demo").read_text(), "wavy", spp=16, seed=seed)


def run(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Each subject that there is data for; see `study`."""
    folder = args.out / "light_planes"
    framings = {k: v for k, v in {**FRAMINGS, "demo": None}.items() if args.only in (None, k)}
    if not framings:
        raise LeftOut(f"no subject {args.only!r}; there are {', '.join(FRAMINGS)} and demo")
    also = ["drifting"] if args.quick else args.also  # a board does not show in so few pixels
    if args.quick:
        framings = {"curly": replace(FRAMINGS["curly"], rows=21, coarser=6)}
    for k, (name, framing) in enumerate(framings.items()):
        if name in ("sintel", "ponytail") and data_folder() is None:
            continue
        report_progress = within(progress, name, k / len(framings), 1 / len(framings))
        if framing is None:
            made, options = [demo_capture(args.seed)], ReconstructOptions()
        else:
            drifts = (0.0, DRIFT_MM) if "drifting" in also else (0.0,)
            made = [
                subject_capture(
                    name, framing, args.cache, drift, seed=args.seed, projectors=args.projectors
                )
                for drift in drifts
            ]
            options = ReconstructOptions(max_length=framing.longest)
        options = replace(options, seed=args.seed)
        if args.quick:
            options = replace(options, grid=4e-3, roots=500)
        study(
            folder / name,
            SubjectCaptures(*(capture.make(args.cache, report_progress) for capture in made)),
            options,
            grown="grown" in also,
            without_help="without_help" in also,
            studies=name == "sintel" and "studies" in also,
            progress=report_progress,
        )
    done = {f.parent.name: json.loads(f.read_text()) for f in sorted(folder.glob("*/result.json"))}
    results = {"paper": PAPER, "subjects": done}
    save(args.out / "light_planes.json", results)
    return results


PARTS = ["grown", "drifting", "without_help", "studies"]
ALSO = option("--also", "beside the still capture", nargs="*", choices=PARTS, default=PARTS)
SWEEPING = option(
    "--projectors",
    "how many sweep (the demo's rig has three)",
    type=int,
    choices=range(1, len(PROJECTORS) + 1),
    default=3,
)
BENCHMARK = Benchmark(run, (CACHE, ONLY, ALSO, SWEEPING))

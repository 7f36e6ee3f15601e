"""`bench lightplanes`: its three subjects, framed by one rig, still and drifting."""

from __future__ import annotations

import json
import math
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.captures import SimulatedCapture
from reconstruction.files.strands import read_strands, write_strands
from reconstruction.geometry.mesh import write_obj
from reconstruction.geometry.strands import Strands
from reconstruction.head.fit import fit_head
from reconstruction.images.orientation import LogGaborBank
from reconstruction.pipeline import ReconstructOptions
from reconstruction.report.report import Progress
from reconstruction.tangents.estimate import MeasureOptions

CAMERAS, PROJECTORS = 8, 3
WIDTH, HEIGHT, ROWS, LIGHTS = 320, 400, 256, 120
DRIFT_MM = 4.0
OPTIONS = ReconstructOptions(
    grid=1.5e-3,
    margin=1e-3,
    roots=20000,
    measure=MeasureOptions(
        bank=LogGaborBank(wavelength=4.0, count=24, spread=1.5),
        texture_scale=3.0,
        radius=3e-3,
        neighbours=32,
        thin=1.25e-3,
        reflection_weight=1.5,
        tolerance=1.5e-3,
    ),
)
"""One setting for all subjects: finer than the defaults, whose pixels are twice as large."""

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


FRAMINGS = {
    "sintel": Framing((0.0, 0.0, -0.025), 0.29, 0.25, 64),
    "ponytail": Framing((0.0, 0.06, -0.06), 0.36, 0.35),
    "curly": Framing((0.0, 0.01, 0.01), 0.31, 0.15),
}


def rig_text(framing: Framing, tracking_every: int = 64) -> str:
    """A rig file: 8 cameras of 320×400 around, every other one raised, 3 projectors of 256 rows."""
    target = list(framing.target)
    fov_deg = math.degrees(2 * math.atan(framing.width / 2 / _DISTANCE))
    text = [
        'name = "lightplanes"',
        f"[dome]\nlights = {LIGHTS}\nradius = 1.2\nlowest_deg = -50.0",
        "intensity = [8.0, 8.0, 8.0]\nbeside_cameras_at = 0.05",
    ]

    def place(azimuth_deg: float, elevation_deg: float, distance: float) -> list[float]:
        a, e = math.radians(azimuth_deg), math.radians(elevation_deg)
        on_sphere = (math.sin(a) * math.cos(e), -math.cos(a) * math.cos(e), math.sin(e))
        return [round(distance * x + t, 4) for x, t in zip(on_sphere, target, strict=True)]

    for k in range(CAMERAS):
        position = place(360 / CAMERAS * k, (8, 30)[k % 2], _DISTANCE)
        text.append(
            f'[[cameras]]\nname = "cam_{k:02d}"\nposition = {position}\ntarget = {target}\n'
            f"fov_deg = {fov_deg:.3f}\nwidth = {WIDTH}\nheight = {HEIGHT}"
        )
    across = math.degrees(2 * math.atan(0.625 * framing.width / 1.1))
    for k, (azimuth, elevation) in enumerate([(180, 15), (300, 35), (60, 15)]):
        text.append(
            f'[[projectors]]\nname = "proj_{k}"\nposition = {place(azimuth, elevation, 1.1)}\n'
            f"target = {target}\nfov_deg = {across:.3f}\nroll_deg = 90.0\nwidth = {ROWS * 5 // 4}\n"
            f"height = {ROWS}\nintensity = [20.0, 20.0, 20.0]\nline_sigma = 0.6"
        )
    text.append(
        "[devices]\nheartbeat_s = 0.5\nwatchdog_s = 2.0\n"
        '[devices.lights]\nkind = "modbus_tcp"\nhost = "127.0.0.1"\nport = 15020\n'
        '[devices.trigger]\nkind = "serial"\nport = "trigger"\n'
        '[devices.projectors]\nkind = "serial"\nport = "projectors"\n'
        '[devices.cameras]\nkind = "link"\nhost = "127.0.0.1"\nport = 15021\n'
        "timeout_s = 60.0\nbusy_s = 1800.0\n"
        "[safety]\nliving_subject = false"
    )
    exposure = ", ".join(f"{k} = 0.02" for k in ("dark", "all_on", "olat", "scanline", "tracking"))
    text.append(
        f"[capture]\ntracking_every = {tracking_every}\nretries = 2\nexposure = {{{exposure}}}\n"
        "level = {all_on = 0.05, olat = 1.0, scanline = 1.0, tracking = 0.4}"
    )
    return "\n\n".join(text) + "\n"


def ponytail(source: Path, folder: Path) -> tuple[Path, Path]:
    """AMD's ponytail with its face towards −y, and the generic head fitted under its roots."""
    strands = read_strands(source)
    turn = np.diag([-1.0, -1.0, 1.0]).astype(np.float32)
    strands = Strands(strands.points @ turn, strands.offsets, strands.radius)
    roots = strands.points[strands.offsets[:-1]]
    hair, head = folder / "ponytail.npz", folder / "ponytail_head.obj"
    fit = fit_head(roots, part="scalp")
    write_strands(hair, strands)
    write_obj(head, fit.mesh)
    return hair, head


def subject_capture(
    name: str, data: Path, cache: Path, drift_mm: float, spp: int = 16
) -> SimulatedCapture:
    """The capture of a subject of `FRAMINGS`; `data` has the ones that others made."""
    subject, head = name, None
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
    framing = FRAMINGS[name]
    rig = rig_text(framing, framing.rows if drift_mm > 0 else 64)
    return SimulatedCapture(label, rig, subject, head, drift_mm, spp)


def run(
    out: Path, data: Path | None, cache: Path, only: str | None, progress: Progress
) -> dict[str, Any]:
    """Each subject that there is data for (`only` one of them); see `bench_light_planes.subject`.

    Captures are kept in `cache`. Leaves `OUT/<subject>/` and `OUT/lightplanes.json`.
    """
    from benchmarks.light_planes.study import PAPER, SUN, Case, subject

    for k, (name, framing) in enumerate(FRAMINGS.items()):
        if only not in (None, name) or (name != "curly" and data is None):
            continue

        def tell(what: str, share: float, k: int = k, name: str = name) -> None:
            progress(f"{name}: {what}", (k + share) / len(FRAMINGS))

        captures = [
            subject_capture(name, data or Path(), cache, drift).make(cache, tell)
            for drift in (0.0, DRIFT_MM)
        ]
        options = replace(OPTIONS, max_length=framing.longest)
        subject(out / name, Case(*captures), options, studies=name == "sintel", progress=tell)
    done = {f.parent.name: json.loads(f.read_text()) for f in sorted(out.glob("*/result.json"))}
    results = {"paper": PAPER, "sun": SUN, "subjects": done}
    (out / "lightplanes.json").write_text(json.dumps(results, indent=1) + "\n")
    return results

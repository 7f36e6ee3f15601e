"""Patches of heads of fine hair, and a rig whose cameras see one at a given pixel pitch."""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass
from pathlib import Path

from benchmarks.captures import Optics, SimulatedCapture, levels, rig_file
from benchmarks.command import DATA, LeftOut, data_folder
from benchmarks.light_planes.subjects import ponytail
from benchmarks.strand_truth import Ball
from reconstruction import read_strands, write_obj, write_strands
from simulators.subject.fine_groom import fine_groom
from simulators.subject.subject import make_subject

PITCHES = (1.8e-3, 0.9e-3, 0.45e-3, 0.25e-3)
"""Metres a pixel spans at the patch."""

WIDTH = 0.054
"""Metres that a camera's picture shows."""

JUDGED, FINE = 0.021, 0.050
"""Radii, metres: the ball that strands are judged in, and the one with all fibres."""

LIGHTS = 80
CAMERAS = ((0, 8), (-30, 25), (30, 25), (-60, 8), (60, 8), (-15, 50), (20, -15), (85, 30))
"""Azimuth from the patch and elevation in degrees: half of a stage's 16."""

PROJECTORS = ((0, 15), (-60, 35), (60, 35))
_CAMERA_AWAY, _PROJECTOR_AWAY = 0.95, 1.1
_ROW = 2 / 3
"""Widths of a pixel between a projector's rows."""


@dataclass(frozen=True)
class PatchOf:
    """The patch's middle, metres, the direction that faces it, degrees, and the longest hair."""

    center: tuple[float, float, float]
    azimuth: float
    longest: float


SUBJECTS = {
    "sintel": PatchOf((0.0, 0.105, 0.02), 180.0, 0.25),
    "ponytail": PatchOf((-0.006, 0.175, -0.085), 180.0, 0.35),
    "curly": PatchOf((0.0, 0.12, 0.03), 180.0, 0.15),
    "wavy": PatchOf((0.0, 0.11, 0.02), 180.0, 0.18),
}
TUNING = "wavy"
"""The subject that methods are tuned on; the others are not."""


def rig_text(patch: PatchOf, pitch: float) -> str:
    """A rig file: cameras of square pictures, projectors with rows of two thirds of a pixel."""
    side = round(WIDTH / pitch)

    def place(azimuth: float, elevation: float, away: float) -> list[float]:
        a, e = math.radians(patch.azimuth + azimuth), math.radians(elevation)
        out = (math.sin(a) * math.cos(e), -math.cos(a) * math.cos(e), math.sin(e))
        return [away * x + t for x, t in zip(out, patch.center, strict=True)]

    optics = Optics(patch.center, math.degrees(2 * math.atan(WIDTH / 2 / _CAMERA_AWAY)))
    devices = [
        optics.device("cameras", k, place(*at, _CAMERA_AWAY)) + f"width = {side}\nheight = {side}"
        for k, at in enumerate(CAMERAS)
    ]
    height = 1.1 * WIDTH
    rows = round(height / (_ROW * pitch))
    wide = Optics(patch.center, math.degrees(2 * math.atan(1.25 * height / 2 / _PROJECTOR_AWAY)))
    devices += [
        wide.device("projectors", k, place(*at, _PROJECTOR_AWAY))
        + f"roll_deg = 90.0\nwidth = {rows * 5 // 4}\nheight = {rows}\n"
        "intensity = [20.0, 20.0, 20.0]\nline_sigma = 0.6"
        for k, at in enumerate(PROJECTORS)
    ]
    dome = f"lights = {LIGHTS}\nradius = 1.2\nlowest_deg = -50.0\nbeside_cameras_at = 0.05"
    return rig_file("pixels", dome, devices, "tracking_every = 100000\n" + levels(all_on=0.05))


def subject_files(name: str, cache: Path, seed: int = 0) -> tuple[Path, Path]:
    """The fine groom and head of a subject of `SUBJECTS`, made under `cache` where missing.

    Raises `LeftOut` where others' strands are missing.
    """
    folder = cache / "fine"
    hair, head = folder / f"{name}-{seed}.npz", folder / f"{name}.obj"
    if hair.is_file() and head.is_file():
        return hair, head
    folder.mkdir(parents=True, exist_ok=True)
    data, patch = data_folder(), SUBJECTS[name]
    with tempfile.TemporaryDirectory(dir=folder) as made:
        if name in ("sintel", "ponytail"):
            if data is None:
                raise LeftOut(f"no folder of data that holds {name}'s strands: name it in ${DATA}")
            guides, mesh = data / "sintel/sintel.npz", data / "sintel/sintel_head.obj"
            if name == "ponytail":
                guides, mesh = ponytail(data / "ponytail/ponytail.npz", Path(made))
            strands = read_strands(guides)
            head.write_bytes(mesh.read_bytes())
        else:
            subject = make_subject(name, seed)
            strands = subject.strands
            assert subject.head is not None
            write_obj(head, subject.head)
        fine = fine_groom(strands, patch.center, FINE, seed=seed)
        write_strands(Path(made) / "fine.npz", fine)
        (Path(made) / "fine.npz").replace(hair)
    return hair, head


def patch_capture(
    name: str, pitch: float, cache: Path, *, spp: int = 16, seed: int = 0
) -> tuple[SimulatedCapture, Ball]:
    """What is captured of a subject at `pitch` metres a pixel, and the ball that is judged."""
    hair, head = subject_files(name, cache, seed)
    patch = SUBJECTS[name]
    label = f"pixels-{name}-{pitch * 1e6:.0f}um"
    capture = SimulatedCapture(label, rig_text(patch, pitch), str(hair), str(head), 0.0, spp, seed)
    return capture, Ball(patch.center, JUDGED)

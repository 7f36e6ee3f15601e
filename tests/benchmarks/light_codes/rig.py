"""The subjects of the patches, and a rig whose cameras look at one."""

from __future__ import annotations

import math
from dataclasses import dataclass

from benchmarks.captures import Optics, SimulatedCapture, levels, rig_file
from benchmarks.command import DATA, LeftOut, data_folder
from benchmarks.strand_truth import Ball
from reconstruction.geometry.lights import dome_positions

CAMERAS = 24
SIDE = 256
"""Pixels of a picture's edge."""

PITCH = 3e-4
"""Metres a pixel spans at the patch: strands are two to three pixels wide."""

DISTANCE = 1.0
TARGETS = {"sintel": (0.0515, 0.0515, 0.0851), "wavy": (0.0529, 0.0529, 0.0874)}
"""Middles of the patches, metres: behind and left of the crown; hair is 2 to 3 cm thick there."""

SPP = 12


@dataclass(frozen=True)
class Patch:
    """What is captured: the capture's description and the ball it is judged in."""

    capture: SimulatedCapture
    ball: Ball


def rig_text(
    target: tuple[float, float, float],
    side: int = SIDE,
    cameras: int = CAMERAS,
    width: float = SIDE * PITCH,
) -> str:
    """A rig file: cameras on the upper hemisphere, a light beside each, and half as many more.

    Pictures of `side` pixels show `width` metres.
    """
    optics = Optics(target, math.degrees(2 * math.atan(width / 2 / DISTANCE)))
    devices = [
        optics.device("cameras", k, [p + t for p, t in zip(place, target, strict=True)])
        + f"width = {side}\nheight = {side}"
        for k, place in enumerate(dome_positions(cameras, DISTANCE, 5.0).tolist())
    ]
    dome = f"lights = {cameras * 3 // 2}\nradius = {DISTANCE}\nbeside_cameras_at = 0.03"
    return rig_file("light_codes", dome, devices, levels(all_on=0.15))


def patch(
    name: str, *, side: int = SIDE, cameras: int = CAMERAS, spp: int = SPP, seed: int = 0
) -> Patch:
    """The patch of a subject in `TARGETS`. Raises `LeftOut` where Sintel's strands are missing."""
    subject, head, data = name, None, data_folder()
    if name == "sintel":
        if data is None:
            raise LeftOut(f"no folder of data that holds Sintel's strands: name it in ${DATA}")
        subject, head = (str(data / "sintel" / f) for f in ("sintel.npz", "sintel_head.obj"))
    target = TARGETS[name]
    rig = rig_text(target, side, cameras)
    capture = SimulatedCapture(f"patch-{name}", rig, subject, head, 0.0, spp, seed)
    return Patch(capture, Ball(target, SIDE * PITCH / 2))

"""`bench photometric`: its subjects, and a rig whose cameras look at a patch of the hair."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from benchmarks.captures import SimulatedCapture
from reconstruction.geometry.lights import dome_positions

CAMERAS, LIGHTS = 24, 36
SIDE = 256
"""Pixels of a picture's edge."""

PITCH = 3e-4
"""Metres a pixel spans at the patch: strands are two to three pixels wide."""

DISTANCE = 1.0
RADIUS = SIDE * PITCH / 2
"""Metres of the ball that every camera sees whole: in it results are judged."""

TARGETS = {"sintel": (0.0515, 0.0515, 0.0851), "wavy": (0.0529, 0.0529, 0.0874)}
"""Middles of the patches, metres: behind and left of the crown; hair is 2 to 3 cm thick there."""

SPP = 12


@dataclass(frozen=True)
class Patch:
    """What is captured: the capture's description and the ball it is judged in."""

    capture: SimulatedCapture
    center: tuple[float, float, float]
    radius: float = RADIUS


def rig_text(target: tuple[float, float, float]) -> str:
    """A rig file: 24 cameras on the upper hemisphere, 36 lamps on a sphere, 24 beside cameras."""
    fov_deg = math.degrees(2 * math.atan(SIDE * PITCH / 2 / DISTANCE))
    text = [
        'name = "photometric"',
        f"[dome]\nlights = {LIGHTS}\nradius = {DISTANCE}\nintensity = [8.0, 8.0, 8.0]\n"
        "beside_cameras_at = 0.03",
    ]
    for k, place in enumerate(dome_positions(CAMERAS, DISTANCE, 5.0).tolist()):
        position = [round(p + t, 5) for p, t in zip(place, target, strict=True)]
        text.append(
            f'[[cameras]]\nname = "cam_{k:02d}"\nposition = {position}\ntarget = {list(target)}\n'
            f"fov_deg = {fov_deg:.5f}\nwidth = {SIDE}\nheight = {SIDE}"
        )
    text.append(
        "[devices]\nheartbeat_s = 1.0\nwatchdog_s = 10.0\n"
        '[devices.lights]\nkind = "modbus_tcp"\nhost = "127.0.0.1"\nport = 15020\n'
        '[devices.trigger]\nkind = "serial"\nport = "trigger"\n'
        '[devices.cameras]\nkind = "link"\nhost = "127.0.0.1"\nport = 15021\n'
        "timeout_s = 120.0\nbusy_s = 14400.0\n"
        "[safety]\nliving_subject = false"
    )
    exposure = ", ".join(f"{k} = 0.02" for k in ("dark", "all_on", "olat", "scanline", "tracking"))
    text.append(
        f"[capture]\nretries = 2\nexposure = {{{exposure}}}\n"
        "level = {all_on = 0.15, olat = 1.0, scanline = 1.0, tracking = 0.4}"
    )
    return "\n\n".join(text) + "\n"


def patch(name: str, data: Path, spp: int = SPP) -> Patch:
    """The patch of a subject in `TARGETS`; `data` has the ones that others made."""
    subject, head = name, None
    if name == "sintel":
        subject, head = (str(data / "sintel" / f) for f in ("sintel.npz", "sintel_head.obj"))
    target = TARGETS[name]
    return Patch(
        SimulatedCapture(f"patch-{name}", rig_text(target), subject, head, 0.0, spp), target
    )

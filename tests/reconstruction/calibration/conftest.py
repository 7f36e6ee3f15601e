"""A small stage to calibrate: true devices, what one believed of them, and what they shot."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from shooting import believed, shoot

from reconstruction import Camera, Capture, Light, Projector, Rig, Step
from reconstruction.calibration.boards import Board, Sighting
from simulators.frames.frames import Sensor
from simulators.subject.props import Prop, PropResponder, SphereProp, board_pose

POSES = (0, 1, 2, 13, 14, 15, 16, 17, 31)
AZIMUTHS = (-35, 5, 40)
WIDTH, HEIGHT = 288, 240
PLACES = ((0.0, 0.01, 0.02), (0.03, -0.05, -0.03))


def _around(azimuth_deg: float, elevation_deg: float, distance: float) -> np.ndarray:
    a, e = np.radians([azimuth_deg, elevation_deg])
    return distance * np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


@pytest.fixture(scope="session")
def true_rig() -> Rig:
    """Three cameras, the second one with a lens that bends lines, four lamps, a projector."""
    cameras = tuple(
        Camera.look_at(
            f"cam_{k}",
            WIDTH,
            HEIGHT,
            _around(azimuth, (8, 22, -4)[k], 0.95),
            (0, 0.01 * k, 0),
            23.0 + k,
            roll_deg=4.0 * k - 5,
            distortion=[-0.25] if k == 1 else [],
        )
        for k, azimuth in enumerate(AZIMUTHS)
    )
    lights = tuple(
        Light(f"lamp_{k}", _around(azimuth, elevation, 1.2), (8.0, 9.0, 7.0))
        for k, (azimuth, elevation) in enumerate(((-60, 20), (20, 55), (70, -15), (-10, -30)))
    )
    beam = Projector.look_at("beam", 24, 24, (1.0, 0.1, 0.3), (0, 0, 0), 20.0, 85.0)
    return Rig("true", cameras, lights, (replace(beam, intensity=[20.0, 21.0, 19.0]),))


@pytest.fixture(scope="session")
def nominal_rig(true_rig: Rig) -> Rig:
    """What one believed."""
    return believed(true_rig)


@pytest.fixture(scope="session")
def board() -> Board:
    """The board that all poses show."""
    return Board()


@pytest.fixture(scope="session")
def noisy_sightings(true_rig: Rig, board: Board) -> dict[str, dict[str, Sighting]]:
    """Where the cameras find the corners, in pictures with the sensor's noise."""
    sightings: dict[str, dict[str, Sighting]] = {c.name: {} for c in true_rig.cameras}
    for pose in POSES:
        responder = PropResponder(true_rig, board_pose(pose, board), samples=2)
        for k, camera in enumerate(true_rig.cameras):
            response = responder.lights_together(camera.name, 0, np.full(4, 0.5))
            image = np.zeros((HEIGHT * WIDTH, 3))
            image[response.pixels] = response.images[0]
            counts = Sensor().expose(image.reshape(HEIGHT, WIDTH, 3), 0.02, (pose, k))
            grey = (counts.astype(float) - Sensor().black).mean(axis=-1)
            sightings[camera.name][f"pose {pose}"] = board.find(grey)
    return sightings


Shoot = Callable[..., Capture]


@pytest.fixture(scope="session")
def shoot_prop(tmp_path_factory: pytest.TempPathFactory, true_rig: Rig, nominal_rig: Rig) -> Shoot:
    """`shoot_prop(prop, kinds, **changes)` shoots a prop; the capture knows the nominal rig."""

    def make(prop: Prop, steps: Sequence[dict[str, Any]], rig: Rig = true_rig, **more: Any) -> Any:
        path: Path = tmp_path_factory.mktemp("prop") / "capture"
        plan = [Step(index=i, **s) for i, s in enumerate(steps)]
        responder = PropResponder(rig, prop, samples=2)
        return shoot(path, rig, responder, plan, written=nominal_rig, **more)

    return make


def lamp_steps(rig: Rig, level: float, exposure: float) -> list[dict[str, Any]]:
    """Dark, all on, and each lamp alone."""
    first = [
        {"kind": "dark", "exposure": exposure, "level": 0.0},
        {"kind": "all_on", "exposure": 0.02, "level": 0.4},
    ]
    return first + [
        {"kind": "olat", "exposure": exposure, "level": level, "light": x.name} for x in rig.lights
    ]


@pytest.fixture(scope="session")
def diffuse_captures(shoot_prop: Shoot, true_rig: Rig) -> list[Capture]:
    """A diffuse sphere of 6 cm radius and albedo 0.8 in two places."""
    steps = lamp_steps(true_rig, 1.0, 0.02)
    return [shoot_prop(SphereProp(np.array(p), 0.06, 0.8), steps) for p in PLACES]


@pytest.fixture(scope="session")
def mirror_captures(shoot_prop: Shoot, true_rig: Rig) -> list[Capture]:
    """A mirror sphere of 5 cm radius in two places, exposed for its highlights."""
    steps = lamp_steps(true_rig, 0.2, 1e-4)
    return [shoot_prop(SphereProp(np.array(p), 0.05, 0.9, True), steps) for p in PLACES]


@pytest.fixture(scope="session")
def board_captures(shoot_prop: Shoot, board: Board) -> list[Capture]:
    """The board in six poses; the first two with a sweep."""
    lit = [{"kind": "dark", "exposure": 0.02, "level": 0.0}]
    lit.append({"kind": "all_on", "exposure": 0.02, "level": 0.5})
    sweep = [{"kind": "tracking", "exposure": 0.002}] + [
        {"kind": "scanline", "exposure": 0.02, "projector": "beam", "row": r} for r in range(24)
    ]
    return [
        shoot_prop(board_pose(n, board), lit + (sweep if k < 2 else []))
        for k, n in enumerate((0, 1, 16, 17, 14, 15))
    ]

"""Comparison of a calibrated rig with a true or a nominal one, after alignment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from reconstruction.arrays import Array
from reconstruction.calibration.least_squares import minimise, numeric
from reconstruction.geometry.cameras import Camera, Pinhole
from reconstruction.geometry.projectors import Projector
from reconstruction.geometry.rig import Rig
from reconstruction.geometry.rigid_motion import Rigid, align_devices

NOMINAL = 0.03
"""Metres: expected error of nominal positions, RMS of all cameras about their middle."""
SCALE = 0.05  # relative difference of size above which the board's square is doubted
ELSEWHERE, TURNED = 0.15, 15.0
"""Metres and degrees from its nominal pose above which a camera is reported."""


def compare_rigs(found: Rig, truth: Rig) -> dict[str, Any]:
    """Errors of `found` against `truth` after aligning the cameras.

    By camera: `reprojection_px`, mean and largest over a head-sized ball of points; `centre_mm`;
    `turn_deg`. By projector: `rows`, RMS over the same points, and `plane_mm`, the largest distance
    of the planes there; `axis_mm` and `along_axis_mm`, the centre across and along the x axis;
    `turn_deg`. By light: `position` relative to its distance from the origin, `direction_deg`, and
    `intensity`, the worst channel relative to the brightest true one.
    Devices are matched by name; raises `KeyError` for one missing in `truth`.
    """
    ball, found = _ball(), aligned(found, truth)
    cameras = {}
    for ours in found.cameras:
        true = truth.camera(ours.name)
        off = np.linalg.norm(ours.project(ball)[0] - true.project(ball)[0], axis=1)
        cameras[ours.name] = {
            "reprojection_px": [float(off.mean()), float(off.max())],
            "centre_mm": 1e3 * float(np.linalg.norm(ours.center - true.center)),
            "turn_deg": _turn_deg(ours, true),
        }
    projectors = {p.name: _rows(p, truth.projector(p.name), ball) for p in found.projectors}
    lights = {}
    for light in found.lights:
        place, real = light.position, truth.light(light.name)
        distance = float(np.linalg.norm(real.position))
        cosine = place @ real.position / (np.linalg.norm(place) * distance)
        strength = np.abs(light.intensity - real.intensity) / max(real.intensity.max(), 1e-300)
        lights[light.name] = {
            "position": float(np.linalg.norm(place - real.position) / distance),
            "direction_deg": float(np.degrees(np.arccos(np.clip(cosine, -1, 1)))),
            "intensity": float(strength.max()),
        }
    return {"cameras": cameras, "projectors": projectors, "lights": lights}


def aligned(found: Rig, truth: Rig) -> Rig:
    """`found`, moved so that its cameras project a head-sized ball of points most like `truth`'s.

    Aligning poses alone would confuse rotations with principal points. Raises `KeyError`.
    """
    ball = _ball()
    same = [truth.camera(c.name) for c in found.cameras]
    start = align_devices(found.cameras, same)
    true = [c.project(ball)[0] for c in same]

    def residual(x: Array) -> Array:
        back = (Rigid.from_vector(x) @ start).inverse()
        off = [c.project(back(ball))[0] - p for c, p in zip(found.cameras, true, strict=True)]
        return np.concatenate(off).ravel()

    back = (Rigid.from_vector(minimise(numeric(residual), np.zeros(6)).x) @ start).inverse()
    return replace(
        found,
        cameras=tuple(map(back.in_frame, found.cameras)),
        lights=tuple(x.moved(back.rotation, back.translation) for x in found.lights),
        projectors=tuple(map(back.in_frame, found.projectors)),
    )


def unlike_nominal(found: Sequence[Camera], nominal: Sequence[Camera], square: float) -> list[str]:
    """Warnings on cameras `found` that contradict `nominal`, in the same order and frame.

    A wrong length `square` of the board's squares, metres, scales the stage; an exchanged name
    displaces a camera. Neither affects the reprojection error.
    """
    out = []
    ours, theirs = (np.array([c.center for c in cameras]) for cameras in (found, nominal))
    a, b = (float(np.sqrt(((x - x.mean(axis=0)) ** 2).sum(axis=1).mean())) for x in (ours, theirs))
    if b > NOMINAL and abs(a - b) > max(NOMINAL, SCALE * b):
        out.append(
            f"the cameras are {abs(a / b - 1):.0%} "
            f"{'further apart' if a > b else 'closer together'} than in the nominal rig: check "
            f"that a square of the board measures {1e3 * square:g} mm"
        )
    off = np.linalg.norm(ours - theirs, axis=1)
    turn = [_turn_deg(*pair) for pair in zip(found, nominal, strict=True)]
    elsewhere = [
        f"{c.name} {1e2 * far:.0f} cm, {angle:.0f}°"
        for c, far, angle in zip(found, off, turn, strict=True)
        if far > ELSEWHERE or angle > TURNED
    ]
    if elsewhere:
        out.append(
            f"cameras differ from their nominal poses ({'; '.join(elsewhere)}): check for "
            "exchanged names; the world frame is aligned with the nominal positions"
        )
    return out


def _ball() -> Array:
    rng = np.random.default_rng(0)
    way = rng.standard_normal((500, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    return np.asarray(0.1 * rng.uniform(size=(500, 1)) ** (1 / 3) * way)


def _turn_deg(ours: Pinhole, true: Pinhole) -> float:
    return float(np.degrees(Rotation.from_matrix(ours.R @ true.R.T).magnitude()))


def _rows(ours: Projector, true: Projector, ball: Array) -> dict[str, float]:
    row = true.project(ball)[0][:, 1]
    off = ours.project(ball)[0][:, 1] - row
    plane = ours.plane(row)
    away = np.abs((plane[:, :3] * ball).sum(axis=1) + plane[:, 3])
    shift = true.R @ (ours.center - true.center)
    return {
        "rows": float(np.sqrt((off**2).mean())),
        "plane_mm": 1e3 * float(away.max()),
        "axis_mm": 1e3 * float(np.hypot(shift[1], shift[2])),
        "along_axis_mm": 1e3 * float(abs(shift[0])),
        "turn_deg": _turn_deg(ours, true),
    }

"""How far a solved motion is from the true one, in pixels and in millimetres."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from reconstruction import Capture
from reconstruction.arrays import AnyFloats, Array
from reconstruction.light_planes.motion import Motion

PAPER_PIXELS = 1300
"""Photobooth's cameras have 1300 pixels along their longer side: errors are scaled to those."""


def true_motion(capture: Capture, truth: Path) -> Motion:
    """The simulator's own poses at the tracking frames of `capture`; it holds them in between.

    `truth` is the folder that it wrote: `poses.json` and `exposures.jsonl` (the pose of a pulse).
    """
    poses = json.loads((truth / "poses.json").read_text())
    lines = (truth / "exposures.jsonl").read_text().splitlines()
    of_pulse = {e["pulse"]: e["pose"] for e in map(json.loads, lines)}
    pulses = {r.step: r.pulse for r in capture.records.values() if r.pulse is not None}
    steps = [s.index for s in capture.of_kind("tracking") if s.index in pulses]
    period = 2 * max(len(poses) - 1, 1)
    at = [of_pulse[pulses[s]] % period for s in steps]
    found = [poses[min(k, period - k)] for k in at]
    return Motion(
        np.array(steps, np.int64),
        np.array([p["rotation"] for p in found], float).reshape(-1, 3, 3),
        np.array([p["translation"] for p in found], float).reshape(-1, 3),
        between="hold",
    )


def motion_errors(
    capture: Capture, points: AnyFloats, solved: Motion, true: Motion
) -> dict[str, Any]:
    """Errors of `solved` at `points (N, 3)` of the subject, over cameras and tracking frames.

    In pixels of a camera with 1300 along its longer side, at the points in the picture, and in
    millimetres at the points; `median`, `p95` and `most` of each. `turn_deg` and `shift_mm` are
    those of the pose itself, the shift at the points' mean.
    """
    here = solved.at(true.steps)
    pixels, metres, turns, shifts = [], [], [], []
    centre = points.mean(axis=0)
    for (ra, ta), (rb, tb) in zip(
        zip(*here, strict=True), zip(true.rotations, true.translations, strict=True), strict=True
    ):
        ours, theirs = points @ ra.T + ta, points @ rb.T + tb
        metres.append(np.linalg.norm(ours - theirs, axis=1))
        turns.append(np.linalg.norm(Rotation.from_matrix(ra @ rb.T).as_rotvec()))
        shifts.append(np.linalg.norm(centre @ (ra - rb).T + ta - tb))
        for camera in capture.rig.cameras:
            a, b = camera.project(ours), camera.project(theirs)
            visible = (b[1] > 0) & camera.inside(b[0])
            scale = PAPER_PIXELS / max(camera.width, camera.height)
            pixels.append(scale * np.linalg.norm(a[0] - b[0], axis=1)[visible])
    return {
        "pixels": _spread(np.concatenate(pixels)),
        "mm": _spread(1e3 * np.concatenate(metres)),
        "turn_deg": _spread(np.degrees(turns)),
        "shift_mm": _spread(1e3 * np.array(shifts)),
    }


def _spread(values: Array) -> dict[str, float]:
    if not len(values):
        return {}
    median, p95 = np.percentile(values, [50, 95])
    return {"median": float(median), "p95": float(p95), "most": float(values.max())}

"""Captures of a prop without the wires, and what one believes of the stage: for calibrations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from reconstruction import Camera, Capture, CaptureWriter, Rig, Step
from reconstruction.capture.records import FrameRecord
from simulators.frames.frames import FrameMaker, Sensor, Snapshot
from simulators.frames.responses import Responder
from simulators.peers.projector_controller import FULL, Show


def shoot(
    path: Path,
    rig: Rig,
    responder: Responder,
    steps: Sequence[Step],
    *,
    written: Rig | None = None,
    sensor: Sensor = Sensor(),  # noqa: B008  frozen
    seed: int = 0,
    ambient: float = 0.0,
) -> Capture:
    """Expose `steps` on the true `rig` and write the capture `path`, a new folder.

    `written` is what the capture's rig.json says of the stage: nominal places, where nobody knows
    the true ones. `ambient` W/(sr m²) reach every pixel of every frame. Raises `CaptureError`.
    """
    frames = FrameMaker(rig, responder, sensor, seed)
    writer = CaptureWriter.create(path, written or rig, {"steps": list(steps)})
    names = [x.name for x in rig.lights]
    records: list[FrameRecord] = []
    for step in steps:
        power = np.zeros(len(names))
        if step.kind == "all_on":
            power[:] = step.level
        elif step.light is not None:
            power[names.index(step.light)] = step.level
        show = Show()
        if step.kind in ("scanline", "tracking"):
            show = Show(round(step.level * FULL), step.projector, step.row or 0)
        unit = 1 / (sensor.gain * step.exposure)
        for camera in rig.cameras:
            shot = Snapshot(step.index + 1, power, show, 0)
            radiance = frames.radiance(camera.name, shot) + ambient
            counts = sensor.expose(radiance, step.exposure, (seed, len(records)))
            records.append(
                writer.store_frame(
                    step,
                    camera.name,
                    (counts.astype(np.float64) - sensor.black) * unit,
                    full_scale=(sensor.full_scale - sensor.black) * unit,
                    count_scale=unit,
                )
            )
    writer.commit(records)
    writer.finish("completed")
    return Capture(path)


def believed(rig: Rig, seed: int = 1) -> Rig:
    """What one believes of a stage: 1 cm, 1.5°, 4 % of focal lengths and 3 cm of lamps off."""
    rng = np.random.default_rng(seed)

    def off(device: Any) -> Any:
        turn = Rotation.from_rotvec(rng.normal(0, np.radians(1.5), 3)).as_matrix()
        center = device.center + rng.normal(0, 0.01, 3)
        K = device.K.copy()
        K[0, 0], K[1, 1] = 1.04 * K[0, 0], 1.03 * K[1, 1]
        K[:2, 2] += rng.normal(0, 3, 2)
        R = turn @ device.R
        lens = {"distortion": np.zeros(5)} if isinstance(device, Camera) else {}
        return replace(device, K=K, R=R, t=-R @ center, **lens)

    lights = tuple(
        replace(x, position=x.position + rng.normal(0, 0.03, 3), intensity=np.ones(3))
        for x in rig.lights
    )
    cameras, beams = (tuple(map(off, d)) for d in (rig.cameras, rig.projectors))
    return Rig("nominal", cameras, lights, beams)

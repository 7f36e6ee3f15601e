"""Captures of a prop without the wires: for calibrations, whose devices are tested elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from reconstruction import Capture, CaptureWriter, Rig, Step
from reconstruction.capture.folder import FrameRecord
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

"""Shoots a capture onto a disk that is too small for it; prints what came of it as JSON.

`python full_disk.py FOLDER RESERVE`: FOLDER is on a small file system of its own.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

from reconstruction import Camera, CaptureWriter, Rig, Step, verify
from reconstruction.capture.compression import compress
from stage_service.acquisition.frame_queue import FrameWriter, Shot
from stage_service.devices.cameras.interface import CameraInfo, Frame

STEPS = tuple(Step(i, "dark", 0.01, 0.0) for i in range(60))
NAMES = ("cam_0", "cam_1")
INFO = CameraInfo(160, 120, 4095, 64.0, 10000.0)


def shoot(writer: CaptureWriter) -> str:
    """Shoot what is missing; returns the error that ended it, or nothing."""
    frames, error = FrameWriter(writer, 4), ""
    try:
        for step, camera in writer.missing():
            counts = np.full((120, 160, 3), 64 + step.index, np.uint16)
            frames.put(Shot(step, camera, Frame(counts, 1, 0.0, 0.01), INFO, 1, 0))
    except OSError as trouble:
        error = str(trouble)
    try:
        frames.close()
    except OSError as trouble:
        error = str(trouble)
    return error


def main(folder: Path, reserve: int) -> None:
    """Fill the disk, end the capture; then make room and go on."""
    filler = folder / "filler"
    filler.write_bytes(bytes(24 << 20))
    at = Camera.look_at
    rig = Rig("r", tuple(at(n, 160, 120, [0, -1, 0], [0, 0, 0], 20) for n in NAMES), ())
    path = folder / "capture"
    writer = CaptureWriter.create(path, rig, {"steps": STEPS})
    writer.reserve = reserve
    out: dict[str, object] = {"error": shoot(writer)}
    out["written"] = writer.counts()[0]
    try:
        writer.finish("failed", {"error": out["error"]})
    except OSError as error:
        out["finish"] = str(error)
    out["verify"] = verify(path)
    out["in_frames"] = len([p for p in path.glob("frames/*/*") if p.is_file()])
    filler.unlink()
    writer = CaptureWriter.reopen(path)
    writer.reserve = reserve
    out["resumed"] = shoot(writer)
    writer.finish("completed")
    out["verify_resumed"] = verify(path)
    compress(path)
    out["verify_compressed"] = verify(path)
    print(json.dumps(out))


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))

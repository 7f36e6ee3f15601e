"""Bytes written each second by a capture, beside a plain sequential write of as many bytes."""

from __future__ import annotations

import os
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from reconstruction import Camera, CaptureWriter, Rig, Step
from stage_service.acquisition.frame_queue import FrameWriter, Shot, queued_frames
from stage_service.devices.cameras.interface import CameraInfo, Frame

GOAL = 0.8
"""Share of the plain write's rate that a capture is to reach."""

CHUNK = 8 << 20
"""Bytes that the plain write hands over at once."""


def measure(
    folder: Path,
    *,
    width: int = 1280,
    height: int = 1024,
    cameras: int = 16,
    steps: int = 4,
    repetitions: int = 5,
) -> dict[str, Any]:
    """Shoot `steps` of `cameras` frames of `width` x `height` into `folder`, again and again.

    Ours: counts as the cameras send them, through `FrameWriter`, until the last frame is durable
    and in the journal. Plain: as many bytes into one file, one fsync at the end. Each repetition
    does both, one right after the other; the rates are medians in bytes a second, `ratio` is the
    median of the repetitions' ratios, which stand in `ratios`. What was written is removed.
    """
    rig = _rig(width, height, cameras)
    plan = tuple(Step(i, "dark", 0.01, 0.0) for i in range(steps))
    rng = np.random.default_rng(0)
    counts = [rng.integers(0, 4096, (height, width, 3), np.uint16) for _ in range(cameras)]
    ours, plain, size = [], [], 0
    # Removed at the end alone: ext4 looks long for an inode where many were freed just now.
    with tempfile.TemporaryDirectory(dir=folder, prefix="bench-writing-") as own:
        for i in range(repetitions):
            seconds, size = _capture(Path(own, f"capture_{i}"), rig, plan, counts)
            ours.append(size / seconds)
            plain.append(size / _plain(Path(own, f"plain_{i}"), size))
    ratios = [a / b for a, b in zip(ours, plain, strict=True)]
    return {
        "width": width,
        "height": height,
        "cameras": cameras,
        "frames": cameras * steps,
        "bytes": size,
        "bytes_per_s": statistics.median(ours),
        "plain_bytes_per_s": statistics.median(plain),
        "ratio": statistics.median(ratios),
        "ratios": ratios,
        "goal": GOAL,
    }


def _rig(width: int, height: int, cameras: int) -> Rig:
    names = [f"cam_{i:02d}" for i in range(cameras)]
    at = Camera.look_at
    return Rig("bench", tuple(at(n, width, height, [0, -1, 0], [0, 0, 0], 20) for n in names), ())


def _capture(
    path: Path, rig: Rig, steps: tuple[Step, ...], counts: list[np.ndarray]
) -> tuple[float, int]:
    """Seconds that the frames took, and the bytes of their files."""
    writer = CaptureWriter.create(path, rig, {"steps": steps})
    info = CameraInfo(rig.cameras[0].width, rig.cameras[0].height, 4095, 64.0, 10000.0)
    _settle(len(steps) * sum(2 * image.nbytes for image in counts))
    begin = time.perf_counter()
    frames = FrameWriter(writer, queued_frames(rig))
    for step in steps:
        for camera, image in zip(rig.cameras, counts, strict=True):
            frame = Frame(image, step.index + 1, 0.0, step.exposure)
            frames.put(Shot(step, camera.name, frame, info, step.index + 1, 0))
    frames.close()
    seconds = time.perf_counter() - begin
    writer.close()
    return seconds, sum(file.stat().st_size for file in path.rglob("*.exr"))


def _plain(path: Path, size: int) -> float:
    """Seconds that the bytes take as one file."""
    chunk = np.random.default_rng(0).bytes(min(CHUNK, size))
    _settle(size)
    begin = time.perf_counter()
    with path.open("wb", buffering=0) as file:
        for start in range(0, size, len(chunk)):
            file.write(memoryview(chunk)[: size - start])
        os.fsync(file.fileno())
    return time.perf_counter() - begin


def _settle(size: int) -> None:
    """Let the disk finish what it has, and touch as much memory as its cache will take.

    A virtual machine's host takes free memory back; getting it again costs several times what
    writing does, and would fall on whichever of the two writes comes first.
    """
    os.sync()
    np.full(size, 1, np.uint8)

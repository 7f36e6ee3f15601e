"""Captures that are made of other captures."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from reconstruction.capture.folder import Capture
from reconstruction.capture.records import Step
from reconstruction.capture.writer import CaptureWriter
from reconstruction.files.durable import write_whole
from reconstruction.files.exr import read_exr
from reconstruction.geometry.rig import Rig


@contextmanager
def derived(
    source: Capture, out: Path, rig: Rig, plan: dict[str, Any], origin: str
) -> Iterator[CaptureWriter]:
    """Write the capture `out`, a new or empty folder, with masks, head and scalp of `source`, whose
    name the manifest has as `origin`. An error removes it. Raises `CaptureError`."""
    names = [c.name for c in rig.cameras]
    masks, subjects = (
        {c: m for c in names if (m := read(c)) is not None}
        for read in (source.mask, source.subject)
    )
    writer = CaptureWriter.create(out, rig, plan, masks=masks, subjects=subjects, head=source.head)
    try:
        scalp = source.path / "scalp.obj"
        if scalp.is_file():
            write_whole(out / "scalp.obj", scalp.read_bytes())
        yield writer
        writer.finish("completed", {origin: source.path.name})
    except BaseException:
        writer.close()
        shutil.rmtree(out)
        raise


def copy_frame(source: Capture, step: Step, camera: str, writer: CaptureWriter) -> None:
    """Write a frame of `source` as it is, or why it is missing."""
    if not source.has(step, camera):
        record = source.records.get((step.index, camera))
        reason = (record and record.reason) or "it was never captured"
        writer.record_missing(step, camera, reason=reason)
        return
    image, attributes = source.read_file(step, camera, read_exr)
    full, count = (
        float(attributes.get(k, v)) for k, v in (("fullScale", np.inf), ("countScale", 0))
    )
    writer.write_frame(step, camera, image, full_scale=full, count_scale=count)

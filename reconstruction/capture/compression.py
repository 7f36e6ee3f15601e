"""Lossless compression of a finished capture; the capture stays readable at every moment."""

from __future__ import annotations

import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import replace
from io import FileIO
from pathlib import Path

from reconstruction.capture.folder import Capture
from reconstruction.capture.records import CaptureError, FrameRecord
from reconstruction.capture.writer import (
    JournalInUse,
    append_lines,
    checksums,
    open_journal,
    sha256,
)
from reconstruction.files.durable import flush, naming_full_disk, require_free, write_json
from reconstruction.files.exr import read_exr, write_exr
from reconstruction.report.report import Progress, silent

ATTRIBUTES = ("exposureTime", "fullScale", "countScale")
POLL_S = 0.2
TOGETHER = 4
"""Frames compressed in parallel."""


def compress(path: str | Path, progress: Progress = silent) -> int:
    """Rewrite the uncompressed frames of a capture with ZIP; returns the bytes saved.

    `TOGETHER` frames at a time are written under new names, then listed in the journal, then the
    old files are removed, so a crash loses nothing; a second run continues and cleans up. Waits
    while another process has the capture open. Raises `CaptureError` for a frame with a wrong
    checksum, and `DiskFull`.
    """
    path = Path(path)
    _finished(path)
    with _journal_to_ourselves(path, progress) as journal, ThreadPoolExecutor(TOGETHER) as pool:
        capture = _finished(path)
        saved, records = 0, list(capture.records.values())
        for i in range(0, len(records), TOGETHER):
            some = [r for r in records[i : i + TOGETHER] if r.file is not None]
            saved += _compress(capture, some, journal, pool)
            progress("compressing frames", min((i + TOGETHER) / len(records), 1.0))
        assert capture.manifest is not None
        write_json(path / "manifest.json", {**capture.manifest, **checksums(path)})
    return saved


def _finished(path: Path) -> Capture:
    capture = Capture(path)
    if capture.manifest is None:
        raise CaptureError(
            f"{path}: not finished (no manifest.json): compress it after the capture has ended"
        )
    return capture


def _journal_to_ourselves(path: Path, progress: Progress) -> FileIO:
    while True:
        try:
            return open_journal(path)
        except JournalInUse:  # no blocking lock: `progress` raises when the job is cancelled
            progress("waiting for another compression of this capture", 0.0)
            time.sleep(POLL_S)


def _compress(
    capture: Capture, records: Sequence[FrameRecord], journal: FileIO, pool: ThreadPoolExecutor
) -> int:
    """Compress some frames, or remove leftovers of a crash; returns the bytes saved."""
    todo: list[tuple[FrameRecord, Path, Path]] = []
    for record in records:
        current = capture.file_of(record)
        old, new = (current.with_name(record.camera + s) for s in (".exr", ".zip.exr"))
        if current == new:
            old.unlink(missing_ok=True)
        else:
            todo.append((record, old, new))
    size = sum(old.stat().st_size for _, old, _ in todo)
    require_free(capture.path, size, reserve=0)  # temporary
    running = [pool.submit(_compressed, capture, *each) for each in todo]
    wait(running)
    try:
        made = [frame.result() for frame in running]
    except BaseException:
        for _, _, new in todo:
            new.unlink(missing_ok=True)
        raise
    append_lines(journal, made)
    saved = size - sum(new.stat().st_size for _, _, new in todo)
    for _, old, _ in todo:
        old.unlink()
    return saved


def _compressed(capture: Capture, record: FrameRecord, old: Path, new: Path) -> FrameRecord:
    """Compress the frame `old` to `new`; returns its new record."""
    if sha256(old) != record.sha256:
        raise CaptureError(
            f"{old}: its checksum differs from the journal's: run 'hairstage verify'"
        )
    image, attributes = read_exr(old)
    with naming_full_disk(new, old.stat().st_size):
        write_exr(new, image, {k: attributes[k] for k in ATTRIBUTES if k in attributes})
        flush(new.parent)
    return replace(record, file=str(new.relative_to(capture.path)), sha256=sha256(new))

"""Compressing a finished capture, frame by frame, without a moment at which it is not whole."""

from __future__ import annotations

import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import replace
from io import FileIO
from pathlib import Path

from reconstruction.capture.folder import Capture, CaptureError, FrameRecord
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
"""Frames that are compressed at the same time: while one waits for the disk, others go on."""


def compress(path: str | Path, progress: Progress = silent) -> int:
    """Rewrite the uncompressed frames of a capture with ZIP, losslessly; returns the bytes saved.

    `TOGETHER` frames at a time get new names, then journal lines, and only then are the old files
    removed, so a crash leaves the capture whole; run it again to go on, and to remove what the
    crash left over. Waits while somebody else writes or compresses the capture. Raises
    `CaptureError` for a frame whose checksum is wrong (compression must not make damage look
    sound), `DiskFull`.
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
        raise CaptureError(f"{path}: not finished; compress a capture after its manifest is there")
    return capture


def _journal_to_ourselves(path: Path, progress: Progress) -> FileIO:
    while True:
        try:
            return open_journal(path)
        except JournalInUse:  # no blocking call: `progress` is where a job hears that it is ended
            progress("waiting for another compression of this capture", 0.0)
            time.sleep(POLL_S)


def _compress(
    capture: Capture, records: Sequence[FrameRecord], journal: FileIO, pool: ThreadPoolExecutor
) -> int:
    """Compress some frames, or end what a crash interrupted; returns the bytes saved."""
    todo: list[tuple[FrameRecord, Path, Path]] = []
    for record in records:
        current = capture.file_of(record)
        old, new = (current.with_name(record.camera + s) for s in (".exr", ".zip.exr"))
        if current == new:
            old.unlink(missing_ok=True)
        else:
            todo.append((record, old, new))
    size = sum(old.stat().st_size for _, old, _ in todo)
    require_free(capture.path, size, reserve=0)  # less is needed soon
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
    """The record of the frame `old` as it is written to `new`."""
    if sha256(old) != record.sha256:
        raise CaptureError(f"{old}: its checksum is not the journal's; run verify")
    image, attributes = read_exr(old)
    with naming_full_disk(new, old.stat().st_size):
        write_exr(new, image, {k: attributes[k] for k in ATTRIBUTES if k in attributes})
        flush(new.parent)
    return replace(record, file=str(new.relative_to(capture.path)), sha256=sha256(new))

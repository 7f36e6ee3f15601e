"""Compressing a finished capture, frame by frame, without a moment at which it is not whole."""

from __future__ import annotations

import time
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


def compress(path: str | Path, progress: Progress = silent) -> int:
    """Rewrite the uncompressed frames of a capture with ZIP, losslessly; returns the bytes saved.

    Each frame gets a new name, then a journal line, and only then is the old file removed, so a
    crash leaves the capture whole; run it again to go on, and to remove what the crash left over.
    Waits while somebody else writes or compresses the capture. Raises `CaptureError` for a frame
    whose checksum is wrong (compression must not make damage look sound), `DiskFull`.
    """
    path = Path(path)
    _finished(path)
    with _journal_to_ourselves(path, progress) as journal:
        capture = _finished(path)
        saved = 0
        for i, record in enumerate(capture.records.values()):
            if record.file is not None:
                saved += _compress(capture, record, journal)
            progress("compressing frames", (i + 1) / len(capture.records))
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


def _compress(capture: Capture, record: FrameRecord, journal: FileIO) -> int:
    """Compress one frame, or end what a crash interrupted; returns the bytes saved."""
    assert record.file is not None
    current = capture.file_of(record)
    old, new = (current.with_name(record.camera + s) for s in (".exr", ".zip.exr"))
    if current == new:
        old.unlink(missing_ok=True)
        return 0
    if sha256(old) != record.sha256:
        raise CaptureError(f"{old}: its checksum is not the journal's; run verify")
    image, attributes = read_exr(old)
    size = old.stat().st_size
    require_free(capture.path, size, reserve=0)  # less is needed soon
    with naming_full_disk(new, size):
        write_exr(new, image, {k: attributes[k] for k in ATTRIBUTES if k in attributes})
        flush(new.parent)
        file = str(new.relative_to(capture.path))
        append_lines(journal, [replace(record, file=file, sha256=sha256(new))])
    saved = size - new.stat().st_size
    old.unlink()
    return saved

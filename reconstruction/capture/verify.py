"""Verification of a capture folder."""

from __future__ import annotations

import fcntl
import hashlib
from collections.abc import Iterator
from pathlib import Path

from reconstruction.capture.folder import Capture
from reconstruction.capture.records import CaptureError, FrameRecord
from reconstruction.capture.writer import sha256, unlisted_files
from reconstruction.containment import inside
from reconstruction.files.exr import read_exr
from reconstruction.report.report import Progress, silent


def verify(path: str | Path, progress: Progress = silent) -> list[str]:
    """Re-read every file of a capture; returns one sentence per problem.

    Checked are the small files and the journal against the manifest, every frame's checksum,
    decoding and size, missing frames, and files under frames/ that the journal does not list.
    """
    path = Path(path)
    try:
        capture = Capture(path)
    except (ValueError, KeyError, OSError) as error:
        return [f"The capture cannot be read: {error}"]
    problems = [*_journal(path / "journal.jsonl"), *_manifest(capture)]
    recorded = [r for r in capture.records.values() if r.file is not None]
    for i, record in enumerate(recorded):
        try:
            problems += _frame(capture, _now(capture, record))
        except CaptureError as error:
            problems.append(f"Step {record.step}, {record.camera}: {error}.")
        progress("verifying frames", (i + 1) / len(recorded))
    return [*problems, *_absent(capture), *_left_over(path)]


def _journal(journal: Path) -> Iterator[str]:
    if not journal.is_file():
        yield "journal.jsonl is missing: no frame can be accounted for."
    elif not (b"\n" + journal.read_bytes()).endswith(b"\n"):
        yield (
            "journal.jsonl ends in an incomplete line, as after a crash: its frame is not "
            "accounted for."
        )


def _manifest(capture: Capture) -> Iterator[str]:
    try:
        manifest = capture.manifest
    except CaptureError as error:
        yield f"manifest.json cannot be read: {error}."
        return
    if manifest is None:
        yield "manifest.json is missing: the capture was not finished."
        return
    if (outcome := manifest.get("outcome")) != "completed":
        yield f"The capture's outcome is {outcome!r}, not 'completed'."
    files, known = manifest.get("files", {}), manifest.get("journal", {})
    if not (isinstance(files, dict) and isinstance(known, dict)):
        yield "manifest.json is damaged: 'files' and 'journal' have no checksums."
        return
    for name, expected in files.items():
        try:
            file = inside(capture.path, name)
        except ValueError as error:
            yield f"manifest.json is damaged: {error}."
            continue
        if not file.is_file():
            yield f"{name} is missing; the manifest lists it."
        elif sha256(file) != expected:
            yield f"{name} does not match its checksum in the manifest."
    journal = capture.path / "journal.jsonl"
    if not journal.is_file():
        return
    data, count = journal.read_bytes(), known.get("bytes", 0)
    if not isinstance(count, int) or count < 0:
        yield f"manifest.json is damaged: the journal's length is {count!r}."
    elif len(data) < count:
        yield f"journal.jsonl has {len(data)} bytes, fewer than the manifest's {count}."
    elif hashlib.sha256(data[:count]).hexdigest() != known.get("sha256"):
        yield "journal.jsonl does not match its checksum in the manifest."


def _now(capture: Capture, record: FrameRecord) -> FrameRecord:
    """The current record, if compression has replaced the file."""
    assert record.file is not None
    if capture.file_of(record).exists():
        return record
    now = Capture(capture.path).records[record.step, record.camera]
    return record if now.file is None else now


def _left_over(path: Path) -> Iterator[str]:
    """Files left by an interrupted write or compression; not checked while one runs."""
    journal = path / "journal.jsonl"
    if not journal.is_file():
        return
    with journal.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return
        unlisted = [str(p.relative_to(path)) for p in unlisted_files(Capture(path))]
    if unlisted:
        yield (
            f"{len(unlisted)} files under frames/ are not listed in the journal, as after an "
            f"interrupted write or compression; the first is {unlisted[0]}."
        )


def _frame(capture: Capture, record: FrameRecord) -> list[str]:
    assert record.file is not None
    what = f"{record.file} (step {record.step}, {record.camera})"
    try:
        camera = capture.rig.camera(record.camera)
    except KeyError:
        return [f"{what}: the rig has no such camera."]
    file = capture.file_of(record)
    if not file.is_file():
        return [f"{what} is missing; the journal lists it."]
    if sha256(file) != record.sha256:
        return [f"{what} does not match its checksum in the journal."]
    try:
        image, _ = read_exr(file)
    except ValueError as error:
        return [f"{what} does not decode: {error}."]
    if image.shape != (expected := (camera.height, camera.width, 3)):
        return [f"{what} has the shape {image.shape}, expected {expected}."]
    return []


def _absent(capture: Capture) -> Iterator[str]:
    never = []
    for step in capture.steps:
        for camera in capture.rig.cameras:
            if capture.has(step, camera.name):
                continue
            record = capture.records.get((step.index, camera.name))
            if record is None:
                never.append((step, camera.name))
            else:
                yield f"Step {step.index} ({step.kind}), {camera.name} is missing: {record.reason}."
    if never:
        step, name = never[0]
        yield (
            f"{len(never)} planned frames were never captured; the first is step {step.index} "
            f"({step.kind}), {name}."
        )

"""Writing capture folders: frames first, then their journal lines, the manifest last.

Every frame in the journal survives a crash: a frame's file and its name are flushed before its
line is appended and flushed. `reopen` continues such a folder. `DiskFull` is raised while there is
still room to `finish`.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from io import FileIO
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from reconstruction.arrays import AnyFloats
from reconstruction.capture.folder import Capture
from reconstruction.capture.records import CaptureError, FrameRecord, Step
from reconstruction.containment import inside
from reconstruction.files.durable import (
    RESERVE,
    FileSystem,
    append_whole,
    flush,
    part,
    replace_durably,
    require_free,
    write_json,
    write_pages,
    write_whole,
    writing,
)
from reconstruction.files.exr import UncompressedExr
from reconstruction.geometry.mesh import Mesh, write_obj
from reconstruction.geometry.rig import Rig


class JournalInUse(CaptureError):
    """Another process or writer has the capture open."""


@dataclass
class _Stored:
    """An uncommitted frame file; `direct`: written past the page cache."""

    path: Path
    temporary: Path
    direct: bool = False


def require_vacant(path: Path) -> None:
    """Raise `CaptureError` unless `path` is a new or empty folder."""
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise CaptureError(f"{path}: a capture needs a new or empty folder")


class CaptureWriter:
    """Writes one capture folder; `write_frame` and `record_missing` may be called from any thread.

    Made by `create` or `reopen`; `reconstruction.capture.folder` describes the layout. The folder
    is locked until `finish` or `close`; `reserve` bytes of the disk stay free.
    """

    def __init__(self, capture: Capture, journal: FileIO) -> None:
        self.reserve = RESERVE
        self.path = capture.path
        self.rig = capture.rig
        self.steps = capture.steps
        self.records: dict[tuple[int, str], FrameRecord] = dict(capture.records)
        self._known = {s.index: s for s in capture.steps}
        self._lock = threading.Lock()
        self._journal = journal
        self._stored: dict[str, _Stored] = {}  # by the file names of their records
        self._folders: set[str] = set()  # that exist
        self._disk = FileSystem(capture.path)
        self._of_thread = threading.local()

    @classmethod
    def create(
        cls,
        path: str | Path,
        rig: Rig,
        plan: dict[str, Any],
        *,
        masks: dict[str, NDArray[Any]] | None = None,
        head: Mesh | None = None,
        subjects: dict[str, NDArray[Any]] | None = None,
    ) -> Self:
        """Start a capture in the new or empty folder `path`.

        `plan["steps"]` lists `Step.to_dict()`s (or `Step`s); other fields of the plan are stored.
        `masks` maps camera names to hair masks `(H, W)`, boolean or 0..255, `subjects` to masks of
        hair, head and body. Raises `CaptureError`.
        """
        path = Path(path)
        require_vacant(path)
        if "steps" not in plan:
            raise CaptureError("plan.json: the field 'steps' is missing")
        steps = [s if isinstance(s, Step) else Step.from_dict(s) for s in plan["steps"]]
        indices = [s.index for s in steps]
        if len(set(indices)) != len(indices):
            twice = sorted({i for i in indices if indices.count(i) > 1})[:5]
            raise CaptureError(f"plan.json: duplicate step indices {twice}")
        images = {
            f"{folder}/{name}.png": _mask(rig, name, mask)
            for folder, given in (("masks", masks), ("subjects", subjects))
            for name, mask in (given or {}).items()
        }

        (path / "frames").mkdir(parents=True)
        write_json(path / "rig.json", rig.to_dict())
        for file, image in images.items():
            done, png = cv2.imencode(".png", image)
            if not done:
                raise CaptureError(f"{file}: cannot be written")
            (path / file).parent.mkdir(exist_ok=True)
            write_whole(path / file, png.tobytes())
        if head is not None:
            with writing(path / "head.obj") as temporary:
                write_obj(temporary, head)
        journal = open_journal(path)
        write_json(path / "plan.json", {**plan, "steps": [s.to_dict() for s in steps]})
        flush(path)
        return cls(Capture(path), journal)

    @classmethod
    def reopen(cls, path: str | Path) -> Self:
        """Continue an interrupted capture: an incomplete last journal line is cut off, a manifest
        is removed until `finish`. Raises `CaptureError` if there is no capture, or another process
        has it open."""
        before = Capture(path)
        for folder in (
            "masks",
            "subjects",
            *(f"frames/{f.name}" for f in before.path.glob("frames/*")),
        ):
            inside(before.path, folder)
        journal = open_journal(Path(path))
        capture = Capture(path)
        (capture.path / "manifest.json").unlink(missing_ok=True)
        for left_over in unlisted_files(capture):
            if left_over.suffix == ".exr":  # possibly incomplete
                left_over.unlink()
        return cls(capture, journal)

    def missing(self) -> list[tuple[Step, str]]:
        """The frames (step, camera) not yet written, in the plan's order."""
        return [(s, c.name) for s in self.steps for c in self.rig.cameras if not self._has(s, c)]

    def counts(self) -> tuple[int, int]:
        """Frames written and frames recorded as missing so far; does not wait for the disk."""
        records = list(self.records.values())  # atomic
        written = sum(r.file is not None for r in records)
        return written, len(records) - written

    def write_frame(
        self,
        step: Step,
        camera: str,
        radiance: AnyFloats,
        *,
        full_scale: float = math.inf,
        count_scale: float = 0.0,
    ) -> FrameRecord:
        """Write one frame durably and append its journal line: `store_frame`, then `commit`.

        `radiance (H, W, 3)` is scene-linear, W/(sr m²), as exposed at the step's level;
        `full_scale` is the radiance at which a channel saturates (inf: never), `count_scale` the
        radiance of one count (0: not quantised). Raises `CaptureError` for a wrong size, values
        that are not finite, an unknown step, or a frame that is already written.
        """
        scales = {"full_scale": full_scale, "count_scale": count_scale}
        record = self.store_frame(step, camera, radiance, **scales)
        self.commit([record])
        return record

    def store_frame(
        self,
        step: Step,
        camera: str,
        radiance: AnyFloats,
        *,
        full_scale: float = math.inf,
        count_scale: float = 0.0,
    ) -> FrameRecord:
        """Write a frame's file; `commit` makes it durable and part of the capture.

        Thread-safe. Arguments and errors as `write_frame`; `DiskFull` if the file would use the
        reserve.
        """
        self._check(step, camera)
        expected = (self.rig.camera(camera).height, self.rig.camera(camera).width, 3)
        if radiance.shape != expected:
            raise CaptureError(
                f"step {step.index}, {camera}: expected an image {expected}, got {radiance.shape}"
            )
        if not np.isfinite(radiance).all():
            raise CaptureError(
                f"step {step.index}, {camera}: the frame has values that are not finite"
            )
        attributes: dict[str, float | str] = {"exposureTime": float(step.exposure)}
        if math.isfinite(full_scale):
            attributes["fullScale"] = float(full_scale)
        if count_scale > 0:
            attributes["countScale"] = float(count_scale)
        whole = self._buffer(radiance.shape).fill(radiance, attributes)
        require_free(self.path, len(whole), self.reserve)
        folder = f"frames/{step.index:05d}"
        if folder not in self._folders:
            (self.path / folder).mkdir(exist_ok=True)
            self._folders.add(folder)
        name = f"{folder}/{camera}.exr"
        file = self.path / name
        stored = _Stored(file, part(file))
        stored.direct = write_pages(stored.temporary, whole)
        with self._lock:
            self._stored[name] = stored
        checksum = hashlib.sha256(whole).hexdigest()
        return FrameRecord(step.index, camera, name, checksum, recorded=utc_now())

    def commit(self, records: Sequence[FrameRecord]) -> None:
        """Make the records part of the capture: flush files and names, then the journal.

        Flushing many files together takes about as long as flushing one.
        """
        names = [r.file for r in records if r.file is not None]
        files = [self._stored[name] for name in names]
        if len(files) > 1 and self._disk.supported and all(f.direct for f in files):
            for file in files:  # not part of the capture before its journal line
                file.temporary.replace(file.path)
            self._disk.flush()
        else:
            for file in files:
                replace_durably(file.temporary, file.path)
            folders = {file.path.parent for file in files}
            for folder in folders | {folder.parent for folder in folders}:
                flush(folder)
        with self._lock:
            append_lines(self._journal, records)
            self.records.update({(r.step, r.camera): r for r in records})
            for name in names:
                del self._stored[name]

    def _buffer(self, shape: tuple[int, ...]) -> UncompressedExr:
        """This thread's file buffer, made once."""
        buffer: UncompressedExr | None = getattr(self._of_thread, "buffer", None)
        if buffer is None or buffer.shape != shape:
            buffer = self._of_thread.buffer = UncompressedExr(shape[0], shape[1])
        return buffer

    def record_missing(
        self, step: Step, camera: str, *, reason: str, pulse: int | None = None, attempt: int = 0
    ) -> FrameRecord:
        """Journal a missing frame and why; a later `write_frame` replaces the record."""
        self._check(step, camera)
        record = FrameRecord(step.index, camera, None, pulse=pulse, attempt=attempt, reason=reason)
        record = replace(record, recorded=utc_now())
        self.commit([record])
        return record

    def withdraw(self, step: Step, camera: str, *, reason: str) -> None:
        """Mark a written frame as missing and delete its file; it may be written again."""
        record = self.records.get((step.index, camera))
        if record is None or record.file is None:
            return
        gone = replace(record, file=None, sha256=None, recorded=utc_now(), reason=reason)
        self.commit([gone])
        inside(self.path, record.file).unlink()

    def finish(self, outcome: str, extra: dict[str, Any] | None = None) -> dict[str, Any]:
        """Write `manifest.json`, close the journal and return the manifest.

        It has `state` ("done"), `outcome`, frame counts, checksums of the small files and of the
        journal (which has the frames' checksums), and `extra`. Uncommitted frames are removed.
        Raises `OSError` on a full disk.
        """
        self.close()
        manifest = {
            **(extra or {}),
            "state": "done",
            "outcome": outcome,
            "finished": utc_now(),
            "frames": {
                "planned": len(self.steps) * len(self.rig.cameras),
                "written": self.counts()[0],
                "missing": len(self.missing()),
            },
            **checksums(self.path),
        }
        write_json(self.path / "manifest.json", manifest)
        flush(self.path)
        return manifest

    def close(self) -> None:
        """Close the journal without a manifest; the capture counts as interrupted."""
        with self._lock:
            self._journal.close()
            for file in self._stored.values():
                file.temporary.unlink(missing_ok=True)
            self._stored.clear()
            self._disk.close()

    def _has(self, step: Step, camera: Any) -> bool:
        record = self.records.get((step.index, camera.name))
        return record is not None and record.file is not None

    def _check(self, step: Step, camera: str) -> None:
        if self._known.get(step.index) != step:
            raise CaptureError(f"step {step.index}: {step} is not in this capture's plan")
        if self._has(step, self.rig.camera(camera)):
            raise CaptureError(f"step {step.index}, {camera}: this frame is already written")


def unlisted_files(capture: Capture) -> list[Path]:
    """Files under frames/ that no line of the journal names: leftovers of a crash."""
    known = {capture.path / r.file for r in capture.records.values() if r.file is not None}
    return sorted(p for p in capture.path.glob("frames/**/*") if p.is_file() and p not in known)


def open_journal(path: Path) -> FileIO:
    """Open and lock the journal of the capture at `path` for appending.

    An incomplete last line is cut off. Raises `JournalInUse` if another process, or another writer
    of this one, has it open.
    """
    file = inside(path, "journal.jsonl")
    journal = file.open("ab", buffering=0)
    try:
        fcntl.flock(journal, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        journal.close()
        raise JournalInUse(
            f"{path}: it is being written or compressed; wait until that ends"
        ) from None
    data = file.read_bytes()
    journal.truncate(data.rfind(b"\n") + 1)
    return journal


def append_lines(journal: FileIO, records: Sequence[FrameRecord]) -> None:
    """Append records to an open journal and flush it; all or none."""
    lines = []
    for record in records:
        line = {k: v for k, v in vars(record).items() if v is not None}
        line.setdefault("file", None)
        lines.append(json.dumps(line, allow_nan=False) + "\n")
    append_whole(journal, "".join(lines).encode())


def sha256(path: Path) -> str:
    """SHA-256 of a file's bytes, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def utc_now() -> str:
    """The time as UTC ISO 8601, with milliseconds."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def checksums(path: Path) -> dict[str, Any]:
    """Checksums of the small files and of the journal at its current length.

    Compression appends to the journal before it updates the manifest; by the length `verify` checks
    the part that the manifest covers.
    """
    small = [path / n for n in ("rig.json", "plan.json", "head.obj")]
    small += sorted([f for name in ("masks", "subjects") for f in (path / name).glob("[!.]*.png")])
    journal = path / "journal.jsonl"
    return {
        "files": {str(f.relative_to(path)): sha256(f) for f in small if f.is_file()},
        "journal": {"bytes": journal.stat().st_size, "sha256": sha256(journal)},
    }


def _mask(rig: Rig, camera: str, mask: NDArray[Any]) -> NDArray[np.uint8]:
    try:
        c = rig.camera(camera)
    except KeyError as error:
        raise CaptureError(f"masks: {error.args[0]}") from error
    if mask.shape != (c.height, c.width):
        raise CaptureError(
            f"mask of {camera}: expected shape {(c.height, c.width)}, got {mask.shape}"
        )
    grey = mask * np.uint8(255) if mask.dtype == bool else mask
    return np.asarray(grey, np.uint8)

"""Captures, models and uploads under the root folder, and their removal into `trash/`.

Captures that are being shot or written, and what a job uses, cannot be removed. Removed ones can be
restored until an admin empties the trash.
"""

from __future__ import annotations

import fcntl
import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path

from pydantic import BaseModel

from reconstruction import CaptureError, Model, Rig
from reconstruction.capture.writer import JournalInUse, utc_now
from reconstruction.containment import inside, is_file_name
from reconstruction.files.durable import require_free, write_whole
from reconstruction.reading import printable
from stage_service.captures.control import Caller, Control
from stage_service.captures.manager import CaptureManager
from stage_service.decoding import Decoder, Undecodable
from stage_service.jobs.queue import JobQueue
from stage_service.jobs.records import Job
from stage_service.links import check_link, check_links, outward, remove, target_of
from stage_service.trash import Kind, Removed, Trash

KEPT_DAYS = 30.0
"""Default age in days after which the trash may be emptied."""
PAGE_OF_JOBS = 1000


class InUse(RuntimeError):
    """A job, running or pending, needs it."""


class NotThere(LookupError):
    """There is no such model, upload, or entry of the trash."""


class BadUpload(ValueError):
    """The uploaded file is invalid."""


class NotRemoved(RuntimeError):
    """Some entries of the trash could not be deleted: `problems` has each with its reason."""

    def __init__(self, deleted: int, problems: list[str]) -> None:
        summary = f"{deleted} entries of the trash were deleted, {len(problems)} could not be"
        super().__init__(f"{summary}: {problems[0]}")
        self.problems = problems


class Folder(BaseModel):
    """A folder: its files and their total bytes. `link` is its target if it is a link, `outside`
    its links that lead out of it; neither is read."""

    name: str
    files: list[str]
    bytes: int
    link: str | None = None
    outside: list[str] = []


class Storage:
    """Captures, models, uploads and the trash of one root.

    Removing a completed capture or a model needs the scope "admin", an incomplete one "steer".
    """

    def __init__(
        self,
        root: Path,
        captures: CaptureManager,
        control: Control,
        jobs: JobQueue,
        decoder: Decoder,
    ) -> None:
        self._root, self._captures, self._control, self._jobs = root, captures, control, jobs
        self._decoder = decoder
        self._trash, self._uploads = Trash(root / "trash"), root / "uploads"
        self._uploading = threading.Lock()  # a file has one temporary name
        self._emptying = threading.Lock()  # no restore during a deletion

    def models(self) -> list[Folder]:
        """The models, by name."""
        return _folders(self._root / "models")

    def model(self, name: str) -> Model:
        """The model of that name. Raises `NotThere`, `LeadsOutside` for a link."""
        path = self._model_place(name)
        check_link(f"the model {name}", path)
        return Model(path)

    def whole_model(self, name: str) -> Model:
        """As `model`; raises `LeadsOutside` also for a link in it that leads out of it."""
        model = self.model(name)
        check_links(f"the model {name}", model.path)
        return model

    def _model_place(self, name: str) -> Path:
        path = self._root / "models" / name
        if not is_file_name(name) or not (path.is_dir() or path.is_symlink()):
            raise NotThere(f"there is no model {name!r}")
        return path

    def remove_capture(
        self, capture: str, pending: Callable[[str], bool], by: Caller, *, dry_run: bool
    ) -> Removed:
        """Move a capture into the trash, or list what would move. `pending(capture)`: its job is
        still to be enqueued. Raises `UnknownCapture`, `WrongState` while it is shot, `JournalInUse`
        while it is written or compressed, `InUse`, `Forbidden`, `JobsUnavailable`."""
        status = self._captures.get(capture)
        by.require("admin" if status.outcome == "completed" else "steer")
        path = Path(status.path)
        whole = path if path.is_symlink() else path.resolve()  # a link has no jobs of its own
        made = [j for j in self._all_jobs() if Path(j.capture) == whole]
        busy = next((j.id for j in made if j.state != "done"), None)
        if busy is not None or pending(capture):
            raise InUse(f"capture {capture}: {busy or 'a pending job'} needs it: wait, or cancel")
        models = sorted({Path(j.model).name for j in made if Path(j.model).is_dir()})
        found = self._removal("capture", capture, path, by).model_copy(update={"models": models})
        self._captures.check_idle(capture)
        with _no_writer(path):
            if dry_run:
                return found

        def move(folder: Path) -> Removed:
            with _no_writer(folder):
                return self._trash.put(found, folder)

        work = partial(self._captures.set_aside, capture, move)
        removed = self._control.do(by, "capture.remove", work, capture)
        self._publish("removed", removed)
        return removed

    def remove_model(self, name: str, by: Caller, *, dry_run: bool) -> Removed:
        """Move a model into the trash. Raises `NotThere`, `InUse`, `Forbidden`,
        `JobsUnavailable`."""
        by.require("admin")
        model = Model(self._model_place(name))
        busy = self._jobs.at_work_on(model)
        if busy is not None:
            raise InUse(f"model {name}: job {busy} writes it: wait, or cancel it")
        found = self._removal("model", name, model.path, by)
        if dry_run:
            return found
        work = partial(self._trash.put, found, model.path)
        removed = self._control.do(by, "model.remove", work, name, steers=False)
        self._publish("removed", removed)
        return removed

    def trash(self) -> list[Removed]:
        """The entries of the trash, oldest first."""
        return [found for _, found in self._trash.entries()]

    def restore(self, name: str, by: Caller) -> Removed:
        """Restore an entry. Raises `NotThere`, `InUse` where its name is taken, `Forbidden`."""
        by.require("admin")
        with self._emptying:
            entries = self._trash.entries()
            place, found = next((e for e in entries if e[1].name == name), (None, None))
            if place is None or found is None:
                raise NotThere(f"the trash has no {name!r}")
            if found.problem is not None:
                raise NotThere(f"{name} cannot be restored: {found.problem}")
            return self._restore(place, found, by)

    def _restore(self, place: Path, found: Removed, by: Caller) -> Removed:
        def work() -> Removed:
            to = self._root / f"{found.kind}s" / found.id
            if os.path.lexists(to):
                raise InUse(f"{found.kind} {found.id} exists: remove that one first")
            self._trash.take_out(place, found, to)
            if found.kind == "capture":
                self._captures.catalogue.adopt(found.id)
            return found

        restored = self._control.do(by, f"{found.kind}.restore", work, found.id, steers=False)
        self._publish("restored", restored)
        return restored

    def empty(self, older_than_days: float, by: Caller, *, dry_run: bool) -> list[Removed]:
        """Delete entries that are older than `older_than_days`; returns them. Raises `Forbidden`,
        and `NotRemoved` if some could not be deleted, after the others were."""
        by.require("admin")
        before = (datetime.now(UTC) - timedelta(days=older_than_days)).isoformat()
        with self._emptying:
            old = [e for e in self._trash.entries() if e[1].removed <= before]
            if dry_run:
                return [found for _, found in old]
            deleted, problems = [], []
            for place, found in old:
                kind = "trash" if found.kind == "unknown" else found.kind
                work, detail = partial(self._trash.delete, place, found), f"{found.bytes:,} bytes"
                try:
                    self._control.do(
                        by, f"{kind}.delete", work, found.id, detail=detail, steers=False
                    )
                    deleted.append(found)
                except OSError as error:
                    problems.append(f"{found.name} ({found.kind} {found.id}): {error}")
        if problems:
            raise NotRemoved(len(deleted), [printable(p) for p in problems])
        return deleted

    def uploads(self) -> list[Folder]:
        """The uploads, by subject."""
        return _folders(self._uploads)

    def upload_head(self, subject: str, data: bytes, by: Caller) -> Folder:
        """Store a digitised head (OBJ). Raises `BadUpload`, `DecoderBusy`, `DiskFull`."""
        try:
            self._decoder.head(data, "head.obj")
        except Undecodable as error:
            raise BadUpload(str(error)) from error
        return self._upload(subject, "head.obj", data, by)

    def upload_mask(self, subject: str, camera: str, data: bytes, rig: Rig, by: Caller) -> Folder:
        """Store a hair mask (PNG of the camera's size). Raises `BadUpload`,
        `DecoderBusy`, `DiskFull`."""
        known = {c.name: c for c in rig.cameras}
        if camera not in known:
            raise BadUpload(f"masks: the rig has no camera {camera!r}; it has {sorted(known)}")
        name = f"masks/{camera}.png"
        try:
            self._decoder.mask(data, name, known[camera].width, known[camera].height)
        except Undecodable as error:
            raise BadUpload(str(error)) from error
        return self._upload(subject, name, data, by)

    def uploaded(self, subject: str) -> tuple[Path | None, Path | None]:
        """A subject's head and folder of masks, None where missing. Raises `NotThere`,
        `LeadsOutside`."""
        folder = self._upload_place(subject)
        check_links(f"the upload {subject}", folder)
        head, masks = folder / "head.obj", folder / "masks"
        return head if head.is_file() else None, masks if masks.is_dir() else None

    def remove_upload(self, subject: str, by: Caller) -> Folder:
        """Delete an upload; captures have copies of their own. Raises `NotThere`."""
        with self._uploading:
            folder = self._upload_place(subject)
            found, work = _listed(folder), partial(remove, folder)
            self._control.do(by, "upload.delete", work, subject, steers=False)
        return found

    def _upload_place(self, subject: str) -> Path:
        folder = self._uploads / subject
        if not is_file_name(subject) or not (folder.is_dir() or folder.is_symlink()):
            raise NotThere(f"there is no upload {subject!r}")
        return folder

    def _upload(self, subject: str, name: str, data: bytes, by: Caller) -> Folder:
        folder = self._uploads / subject

        def work() -> Folder:
            check_link(f"the upload {subject}", folder)
            require_free(self._root, len(data))
            path = inside(folder, name)
            path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(path, data)
            return _listed(folder)

        detail = f"{name}, {len(data):,} bytes"
        with self._uploading:
            return self._control.do(by, "upload", work, subject, detail=detail, steers=False)

    def _removal(self, kind: Kind, name: str, path: Path, by: Caller) -> Removed:
        listed = _listed(path)
        return Removed(
            name=None,
            kind=kind,
            id=name,
            by=str(by),
            removed=utc_now(),
            bytes=listed.bytes,
            link=listed.link,
        )

    def _publish(self, what: str, found: Removed) -> None:
        self._captures.events.publish(f"{found.kind}.{what}", {"id": found.id})

    def _all_jobs(self) -> Iterator[Job]:
        offset = 0
        while page := self._jobs.all(limit=PAGE_OF_JOBS, offset=offset):
            yield from page
            offset += len(page)


@contextmanager
def _no_writer(capture: Path) -> Iterator[None]:
    """Hold the journal's lock, if there is a journal. Raises `JournalInUse`."""
    if capture.is_symlink():  # its journal is outside
        yield
        return
    try:
        journal = inside(capture, "journal.jsonl").open("rb")
    except (OSError, ValueError):  # a damaged capture may lack it
        yield
        return
    with journal:
        try:
            fcntl.flock(journal, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise JournalInUse(f"{capture}: it is being written or compressed") from None
        yield


def files_of(what: str, folder: Path) -> dict[str, Path]:
    """The complete files of a folder, named `what` in errors, by their relative names. Raises
    `CaptureError` if it is gone, `LeadsOutside` for links out of it."""
    check_links(what, folder)
    if not folder.is_dir():
        raise CaptureError(f"{folder}: {what} is gone: its folder was moved or removed")
    return Model(folder).artifacts()


def _folders(folder: Path) -> list[Folder]:
    """The folders and links in a folder, by name."""
    found = sorted(folder.iterdir()) if folder.is_dir() else []
    return [_listed(p) for p in found if (p.is_dir() or p.is_symlink()) and is_file_name(p.name)]


def _listed(folder: Path) -> Folder:
    if (link := target_of(folder)) is not None:
        return Folder(name=folder.name, files=[], bytes=0, link=link)
    sizes, outside = Model(folder).sizes(), outward(folder)
    files, total = list(sizes)[:1000], sum(sizes.values())
    return Folder(name=folder.name, files=files, bytes=total, outside=outside)

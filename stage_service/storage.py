"""What lies under the root folder: removed into a trash, verified again, uploaded, archived.

Nothing is removed that is being shot, written or used by a job. What is removed goes into
`trash/` and comes back from there until it is emptied, by an admin.
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
"""How long what was removed is kept, where nobody asks for less."""
PAGE_OF_JOBS = 1000


class InUse(RuntimeError):
    """A job, or what is to follow a capture, still needs what was to be removed."""


class NotThere(LookupError):
    """There is no such model, upload, or thing in the trash."""


class BadUpload(ValueError):
    """What was sent is not what its place says."""


class NotRemoved(RuntimeError):
    """Some of what was to be deleted is still in the trash: `problems` names each, and why."""

    def __init__(self, deleted: int, problems: list[str]) -> None:
        told = f"{deleted} entries of the trash were deleted, {len(problems)} could not be"
        super().__init__(f"{told}: {problems[0]}")
        self.problems = problems


class Folder(BaseModel):
    """A folder by its name: its files, and their bytes. `link` is where it leads, if it is a link,
    of which nothing is read; `outside` its links that lead out of it, which are not read either."""

    name: str
    files: list[str]
    bytes: int
    link: str | None = None
    outside: list[str] = []


class Storage:
    """Captures, models, uploads and the trash of one root.

    A capture that completed, and a model, is removed by an admin alone; what did not complete by
    whoever may steer.
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
        self._emptying = threading.Lock()  # what is being deleted must not be restored

    def models(self) -> list[Folder]:
        """The models, by name."""
        return _folders(self._root / "models")

    def model(self, name: str) -> Model:
        """The model of that name. Raises `NotThere`, `LeadsOutside` for a link."""
        path = self._model_place(name)
        check_link(f"the model {name}", path)
        return Model(path)

    def whole_model(self, name: str) -> Model:
        """The same, where no link in it leads out of it either."""
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
        whole = path if path.is_symlink() else path.resolve()  # a link's jobs are another's
        made = [j for j in self._all_jobs() if Path(j.capture) == whole]
        busy = next((j.id for j in made if j.state != "done"), None)
        if busy is not None or pending(capture):
            raise InUse(f"capture {capture}: job {busy or 'to follow'} needs it: wait, or cancel")
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
        self._tell("removed", removed)
        return removed

    def remove_model(self, name: str, by: Caller, *, dry_run: bool) -> Removed:
        """Put a model into the trash. Raises `NotThere`, `InUse`, `Forbidden`,
        `JobsUnavailable`."""
        by.require("admin")
        model = Model(self._model_place(name))
        busy = self._jobs.at_work_on(model)
        if busy is not None:
            raise InUse(f"model {name}: job {busy} makes it: wait, or cancel it")
        found = self._removal("model", name, model.path, by)
        if dry_run:
            return found
        work = partial(self._trash.put, found, model.path)
        removed = self._control.do(by, "model.remove", work, name, steers=False)
        self._tell("removed", removed)
        return removed

    def trash(self) -> list[Removed]:
        """What was removed, oldest first."""
        return [found for _, found in self._trash.entries()]

    def restore(self, name: str, by: Caller) -> Removed:
        """Put something back. Raises `NotThere`, `InUse` where its place is taken, `Forbidden`."""
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
                raise InUse(f"{found.kind} {found.id} is there again: remove that one first")
            self._trash.take_out(place, found, to)
            if found.kind == "capture":
                self._captures.catalogue.adopt(found.id)
            return found

        restored = self._control.do(by, f"{found.kind}.restore", work, found.id, steers=False)
        self._tell("restored", restored)
        return restored

    def empty(self, older_than_days: float, by: Caller, *, dry_run: bool) -> list[Removed]:
        """Delete for good what was removed so many days ago; returns what was. Raises `Forbidden`,
        and `NotRemoved` where some of it cannot be deleted, after all else was."""
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
        """What was uploaded, by subject."""
        return _folders(self._uploads)

    def upload_head(self, subject: str, data: bytes, by: Caller) -> Folder:
        """Keep a digitised head (OBJ). Raises `BadUpload`, `DecoderBusy`, `DiskFull`."""
        try:
            self._decoder.head(data, "head.obj")
        except Undecodable as error:
            raise BadUpload(str(error)) from error
        return self._upload(subject, "head.obj", data, by)

    def upload_mask(self, subject: str, camera: str, data: bytes, rig: Rig, by: Caller) -> Folder:
        """Keep a hair mask (PNG, as large as the camera's frames). Raises `BadUpload`,
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
        """Head and folder of masks of a subject, where there are any. Raises `NotThere`,
        `LeadsOutside`."""
        folder = self._upload_place(subject)
        check_links(f"the upload {subject}", folder)
        head, masks = folder / "head.obj", folder / "masks"
        return head if head.is_file() else None, masks if masks.is_dir() else None

    def remove_upload(self, subject: str, by: Caller) -> Folder:
        """Delete what was uploaded; captures have copies of their own. Raises `NotThere`."""
        with self._uploading:
            folder = self._upload_place(subject)
            found, work = _listed(folder), partial(remove, folder)
            self._control.do(by, "upload.delete", work, subject, steers=False)
        return found

    def _upload_place(self, subject: str) -> Path:
        folder = self._uploads / subject
        if not is_file_name(subject) or not (folder.is_dir() or folder.is_symlink()):
            raise NotThere(f"no subject was uploaded as {subject!r}")
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

    def _tell(self, what: str, found: Removed) -> None:
        self._captures.events.publish(f"{found.kind}.{what}", {"id": found.id})

    def _all_jobs(self) -> Iterator[Job]:
        offset = 0
        while page := self._jobs.all(limit=PAGE_OF_JOBS, offset=offset):
            yield from page
            offset += len(page)


@contextmanager
def _no_writer(capture: Path) -> Iterator[None]:
    """Hold the journal's lock, where there is a journal. Raises `JournalInUse`."""
    if capture.is_symlink():  # its journal is another's
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
    """The whole files that lie under a folder, called `what`, by their relative names, in order.
    Raises `CaptureError` where it has gone, `LeadsOutside` where some of it lies elsewhere."""
    check_links(what, folder)
    if not folder.is_dir():
        raise CaptureError(
            f"{folder}: {what} is not there any more: its folder was moved or removed"
        )
    return Model(folder).artifacts()


def _folders(folder: Path) -> list[Folder]:
    """The folders in one, and the links, wherever they lead, by name."""
    found = sorted(folder.iterdir()) if folder.is_dir() else []
    return [_listed(p) for p in found if (p.is_dir() or p.is_symlink()) and is_file_name(p.name)]


def _listed(folder: Path) -> Folder:
    if (link := target_of(folder)) is not None:
        return Folder(name=folder.name, files=[], bytes=0, link=link)
    sizes, outside = Model(folder).sizes(), outward(folder)
    files, total = list(sizes)[:1000], sum(sizes.values())
    return Folder(name=folder.name, files=files, bytes=total, outside=outside)

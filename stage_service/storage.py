"""What lies under the root folder: removed into a trash, verified again, uploaded, archived.

Nothing is removed that is being shot, written or used by a job. What is removed goes into
`trash/` and comes back from there until it is emptied, by an admin.
"""

from __future__ import annotations

import fcntl
import logging
import secrets
import shutil
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict

from reconstruction import Model, Rig
from reconstruction.capture.writer import JournalInUse, utc_now
from reconstruction.containment import inside, is_file_name
from reconstruction.files.durable import flush, require_free, write_json, write_whole
from reconstruction.reading import read_json
from stage_service.captures.control import Caller, Control
from stage_service.captures.manager import CaptureManager
from stage_service.decoding import Decoder, Undecodable
from stage_service.jobs.queue import JobQueue
from stage_service.jobs.records import Job

log = logging.getLogger("hairstage.storage")
Kind = Literal["capture", "model"]
KEPT_DAYS = 30.0
"""How long what was removed is kept, where nobody asks for less."""
PAGE_OF_JOBS = 1000


class InUse(RuntimeError):
    """A job, or what is to follow a capture, still needs what was to be removed."""


class NotThere(LookupError):
    """There is no such model, upload, or thing in the trash."""


class BadUpload(ValueError):
    """What was sent is not what its place says."""


class Removed(BaseModel):
    """Something in the trash, or (`name` is None) what would go there: "capture" or "model" `id`,
    by whom and when (UTC), its bytes, and the models that were made of a capture and stay."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str | None
    kind: Kind
    id: str
    by: str
    removed: str
    bytes: int
    models: list[str] = []


class Folder(BaseModel):
    """A folder by its name: its files, and their bytes."""

    name: str
    files: list[str]
    bytes: int


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
        self._trash, self._uploads = root / "trash", root / "uploads"
        self._uploading = threading.Lock()  # a file has one temporary name
        self._emptying = threading.Lock()  # what is being deleted must not be restored

    def models(self) -> list[Folder]:
        """The models, by name."""
        folder = self._root / "models"
        found = sorted(folder.iterdir()) if folder.is_dir() else []
        return [_listed(p) for p in found if p.is_dir() and is_file_name(p.name)]

    def model(self, name: str) -> Model:
        """The model of that name. Raises `NotThere`."""
        path = self._root / "models" / name
        if not is_file_name(name) or not path.is_dir():
            raise NotThere(f"there is no model {name!r}")
        return Model(path)

    def remove_capture(
        self, capture: str, owed: Callable[[str], bool], by: Caller, *, dry_run: bool
    ) -> Removed:
        """Put a capture into the trash, or say what would go there. `owed` says whether its job is
        still to be enqueued. Raises `UnknownCapture`, `WrongState` while it is shot, `JournalInUse`
        while it is written or compressed, `InUse`, `Forbidden`, `JobsUnavailable`."""
        status = self._captures.get(capture)
        by.require("admin" if status.outcome == "completed" else "steer")
        path = Path(status.path)
        made = [j for j in self._all_jobs() if Path(j.capture) == path.resolve()]
        busy = next((j.id for j in made if j.state != "done"), None)
        if busy is not None or owed(capture):
            raise InUse(f"capture {capture}: job {busy or 'to follow'} needs it: wait, or cancel")
        models = sorted({Path(j.model).name for j in made if Path(j.model).is_dir()})
        found = self._removal("capture", capture, path, by).model_copy(update={"models": models})
        self._captures.check_idle(capture)
        with _no_writer(path):
            if dry_run:
                return found

        def move(folder: Path) -> Removed:
            with _no_writer(folder):
                return self._into_trash(found, folder)

        work = partial(self._captures.set_aside, capture, move)
        removed = self._control.do(by, "capture.remove", work, capture)
        self._tell("removed", removed)
        return removed

    def remove_model(self, name: str, by: Caller, *, dry_run: bool) -> Removed:
        """Put a model into the trash. Raises `NotThere`, `InUse`, `Forbidden`,
        `JobsUnavailable`."""
        by.require("admin")
        model = self.model(name)
        busy = self._jobs.at_work_on(model)
        if busy is not None:
            raise InUse(f"model {name}: job {busy} makes it: wait, or cancel it")
        found = self._removal("model", name, model.path, by)
        if dry_run:
            return found
        work = partial(self._into_trash, found, model.path)
        removed = self._control.do(by, "model.remove", work, name, steers=False)
        self._tell("removed", removed)
        return removed

    def trash(self) -> list[Removed]:
        """What was removed, oldest first."""
        found = []
        for path in sorted(self._trash.glob("*/removed.json")):
            try:
                removed = Removed.model_validate(read_json(path))
            except (OSError, ValueError) as error:
                log.warning("%s cannot be read: %s", path, error)
                continue
            if (path.parent / removed.id).exists() and is_file_name(removed.id):
                found.append(removed.model_copy(update={"name": path.parent.name}))
        return sorted(found, key=lambda r: r.removed)

    def restore(self, name: str, by: Caller) -> Removed:
        """Put something back. Raises `NotThere`, `InUse` where its place is taken, `Forbidden`."""
        by.require("admin")
        with self._emptying:
            found = next((r for r in self.trash() if r.name == name), None)
            if found is None:
                raise NotThere(f"the trash has no {name!r}")
            return self._restore(found, by)

    def _restore(self, found: Removed, by: Caller) -> Removed:
        place = self._trash / str(found.name)

        def work() -> Removed:
            to = self._root / f"{found.kind}s" / found.id
            if to.exists():
                raise InUse(f"{found.kind} {found.id} is there again: remove that one first")
            (place / found.id).rename(to)
            flush(to.parent)
            shutil.rmtree(place)
            if found.kind == "capture":
                self._captures.catalogue.adopt(found.id)
            return found

        restored = self._control.do(by, f"{found.kind}.restore", work, found.id, steers=False)
        self._tell("restored", restored)
        return restored

    def empty(self, older_than_days: float, by: Caller, *, dry_run: bool) -> list[Removed]:
        """Delete for good what was removed so many days ago; returns what was. `Forbidden`."""
        by.require("admin")
        before = (datetime.now(UTC) - timedelta(days=older_than_days)).isoformat()
        with self._emptying:
            old = [r for r in self.trash() if r.removed <= before]
            for found in [] if dry_run else old:
                work = partial(self._delete, found)
                detail = f"{found.bytes:,} bytes"
                self._control.do(
                    by, f"{found.kind}.delete", work, found.id, detail=detail, steers=False
                )
        return old

    def _delete(self, found: Removed) -> None:
        place = self._trash / str(found.name)
        shutil.rmtree(place / found.id)  # first: what is left of it stays listed until all has gone
        shutil.rmtree(place)

    def uploads(self) -> list[Folder]:
        """What was uploaded, by subject."""
        found = sorted(self._uploads.iterdir()) if self._uploads.is_dir() else []
        return [_listed(p) for p in found if p.is_dir() and is_file_name(p.name)]

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
        """Head and folder of masks of a subject, where there are any. Raises `NotThere`."""
        folder = self._uploads / subject
        if not is_file_name(subject) or not folder.is_dir():
            raise NotThere(f"no subject was uploaded as {subject!r}")
        head, masks = folder / "head.obj", folder / "masks"
        return head if head.is_file() else None, masks if masks.is_dir() else None

    def remove_upload(self, subject: str, by: Caller) -> Folder:
        """Delete what was uploaded; captures have copies of their own. Raises `NotThere`."""
        with self._uploading:
            self.uploaded(subject)
            found = _listed(self._uploads / subject)
            work = partial(shutil.rmtree, self._uploads / subject)
            self._control.do(by, "upload.delete", work, subject, steers=False)
        return found

    def _upload(self, subject: str, name: str, data: bytes, by: Caller) -> Folder:
        folder = self._uploads / subject

        def work() -> Folder:
            require_free(self._root, len(data))
            path = inside(folder, name)
            path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(path, data)
            return _listed(folder)

        detail = f"{name}, {len(data):,} bytes"
        with self._uploading:
            return self._control.do(by, "upload", work, subject, detail=detail, steers=False)

    def _removal(self, kind: Kind, name: str, path: Path, by: Caller) -> Removed:
        size = _listed(path).bytes
        return Removed(name=None, kind=kind, id=name, by=str(by), removed=utc_now(), bytes=size)

    def _into_trash(self, found: Removed, folder: Path) -> Removed:
        name = f"{datetime.now(UTC):%Y%m%d-%H%M%S}-{secrets.token_hex(3)}"
        place = self._trash / name
        place.mkdir(parents=True)
        try:
            write_json(place / "removed.json", found.model_dump(mode="json"))
            folder.rename(place / found.id)
        except BaseException:
            shutil.rmtree(place)
            raise
        flush(place)
        flush(folder.parent)
        return found.model_copy(update={"name": name})

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


def files_of(folder: Path) -> dict[str, Path]:
    """The whole files that lie under a folder, by their relative names, in order."""
    return Model(folder).artifacts()


def _listed(folder: Path) -> Folder:
    sizes = Model(folder).sizes()
    return Folder(name=folder.name, files=list(sizes)[:1000], bytes=sum(sizes.values()))

"""The job queue as the service and the command line use it: no worker code, no HTTP."""

from __future__ import annotations

import fcntl
import logging
import os
import secrets
import sqlite3
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from dbos import DBOS, DBOSClient, DBOSPortableJSONSerializer, WorkflowStatus

from reconstruction import Model
from reconstruction.reading import printable
from stage_service.jobs.progress import read_progress
from stage_service.jobs.records import Job, JobError, JobOutcome, JobState, PipelineRequest

log = logging.getLogger("hairstage.jobs")
APP = "hairstage"
QUEUE = "jobs"
WORKFLOW = "hairstage_job"
SQLITE = "jobs.sqlite"

_STATES: dict[str, tuple[JobState, JobOutcome | None]] = {
    "DELAYED": ("queued", None),
    "ENQUEUED": ("queued", None),
    "PENDING": ("running", None),
    "SUCCESS": ("done", "succeeded"),
    "ERROR": ("done", "failed"),
    "MAX_RECOVERY_ATTEMPTS_EXCEEDED": ("done", "failed"),
    "CANCELLED": ("done", "cancelled"),
}


CONNECT_S = 5
"""A PostgreSQL server that has not taken the connection by then counts as down."""


class NoSuchJob(LookupError):
    """No job has this id."""


class JobsUnavailable(RuntimeError):
    """The job database does not answer, or not usefully."""


def database_url(root: Path) -> str:
    """Where the queue lives: `HAIRSTAGE_DATABASE_URL` (PostgreSQL), else SQLite in `root`."""
    url = os.environ.get("HAIRSTAGE_DATABASE_URL")
    if not url:
        return f"sqlite:///{root.resolve()}/{SQLITE}"
    if url.startswith("postgres") and "connect_timeout=" not in url:
        url += f"{'&' if '?' in url else '?'}connect_timeout={CONNECT_S}"
    return url


def new_job_id() -> str:
    """An id that no other job has, and that sorts by time."""
    return f"job-{datetime.now(UTC):%Y%m%d-%H%M%S}-{secrets.token_hex(3)}"


class JobQueue:
    """Enqueue, read and cancel jobs; works whether or not a worker is running.

    Constructing connects to nothing. Every call does where that is still to be done, and raises
    `JobsUnavailable` while the database does not answer; `problem` is why, or None. A SQLite file
    that is broken is renamed; a new one takes its place, and `set_aside` says so.
    """

    def __init__(self, root: Path) -> None:
        self._root = root
        self._lock = threading.Lock()
        self._client: DBOSClient | None = None
        self.problem: str | None = None
        self.set_aside: str | None = None

    def connect(self) -> None:
        """Open the database, now. Raises `JobsUnavailable`."""
        with self._database():
            pass

    def close(self) -> None:
        """Let go of the database; one that is still being connected to is left to the process."""
        if self._lock.acquire(timeout=1.0):
            client, self._client = self._client, None
            self._lock.release()
            if client is not None:
                client.destroy()

    def submit(self, request: PipelineRequest, capture: Path, model: Model, *, job: str) -> Job:
        """Put a job on the queue; where there is a job of this id already, return that one."""
        spec = {
            "pipeline": request.name,
            "capture": str(capture.resolve()),
            "model": str(model.path.resolve()),
            "options": request.options.to_dict(),
        }
        with self._database() as client:
            client.enqueue(
                {"workflow_name": WORKFLOW, "queue_name": QUEUE, "workflow_id": job}, spec
            )
        return self.get(job)

    def get(self, job: str) -> Job:
        """The job's present state. Raises `NoSuchJob`."""
        with self._database() as client:
            found = client.list_workflows(workflow_ids=[job])
        if not found:
            raise NoSuchJob(f"there is no job {job!r}")
        return _job(found[0])

    def all(self, *, limit: int = 200, offset: int = 0) -> list[Job]:
        """The latest `limit` jobs after the `offset` newest, newest first."""
        with self._database() as client:
            found = client.list_workflows(name=WORKFLOW, sort_desc=True, limit=limit, offset=offset)
        return [_job(w) for w in found]

    def ids(self) -> set[str]:
        """Of every job that there is."""
        with self._database() as client:
            found = client.list_workflows(name=WORKFLOW, load_input=False, load_output=False)
        return {w.workflow_id for w in found}

    def at_work_on(self, model: Model) -> str | None:
        """The id of a job, queued or running, that makes this model."""
        path = str(model.path.resolve())
        with self._database() as client:
            for state in ("PENDING", "ENQUEUED", "DELAYED"):
                for found in client.list_workflows(name=WORKFLOW, status=state):
                    if found.input is not None and found.input["args"][0]["model"] == path:
                        return found.workflow_id
        return None

    def cancel(self, job: str) -> Job:
        """Cancel a job; a step that runs stops at its next progress call. A done job stays done."""
        if self.get(job).state != "done":
            with self._database() as client:
                client.cancel_workflow(job)
        return self.get(job)

    def cancelled(self, job: str) -> bool:
        """Whether the job was cancelled: what a running step asks."""
        with self._database() as client:
            found = client.list_workflows(workflow_ids=[job], load_input=False, load_output=False)
        return bool(found) and found[0].status == "CANCELLED"

    @contextmanager
    def _database(self) -> Iterator[DBOSClient]:
        """The open database; whatever it raises is `JobsUnavailable`."""
        try:
            with self._lock:
                if self._client is None:
                    self._client = self._open()
                client = self._client
            yield client
        except Exception as error:
            reason = next(iter(str(error).splitlines()), "") or type(error).__name__
            self.problem = f"the job database cannot be used: {reason}"
            raise JobsUnavailable(self.problem) from error
        self.problem = None

    def _open(self) -> DBOSClient:
        self._root.mkdir(parents=True, exist_ok=True)
        logging.getLogger("dbos").setLevel(logging.WARNING)
        url = database_url(self._root)
        if url.startswith("sqlite:///"):
            # Service and worker may find the same broken file at the same time.
            with (self._root / "jobs.lock").open("a") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)
                self.set_aside = _set_aside_if_broken(Path(url.removeprefix("sqlite:///")))
                DBOS.migrate(url)
        else:
            DBOS.migrate(url)
        return DBOSClient(
            system_database_url=url,
            serializer=DBOSPortableJSONSerializer(),
            application_name=APP,
            retry_connection_errors=False,
        )


def _set_aside_if_broken(file: Path) -> str | None:
    """Rename a SQLite file, and what belongs to it, that is none or damaged; says what was done."""
    if not file.exists():
        return None
    reason = _broken(file)
    if reason is None:
        return None
    aside = f"{file.name}.broken-{datetime.now(UTC):%Y%m%d-%H%M%S}"
    for suffix in ("-wal", "-shm", "-journal", ""):
        part = file.with_name(file.name + suffix)
        if part.exists():
            part.rename(file.with_name(aside + suffix))
    told = (
        f"{file} was broken ({reason}) and was set aside as {aside}: its jobs are lost. "
        "Models that were begun stay as they are: restart workers, and ask for jobs anew"
    )
    log.error("%s", told)
    return told


def _broken(file: Path) -> str | None:
    """What is wrong with a SQLite file; None where it is sound, or another uses it just now."""
    try:
        with closing(sqlite3.connect(f"{file.as_uri()}?mode=rw", uri=True, timeout=30)) as database:
            (found,) = database.execute("PRAGMA quick_check(1)").fetchone()
            tables = {name for (name,) in database.execute("SELECT name FROM sqlite_master")}
    except sqlite3.OperationalError:  # locked, or not to be opened: what follows says so
        return None
    except sqlite3.DatabaseError as error:
        return str(error)
    if found != "ok":
        return str(found)
    return None if not tables or "dbos_migrations" in tables else "it is another program's"


def _job(status: WorkflowStatus) -> Job:
    assert status.input is not None
    spec: dict[str, Any] = status.input["args"][0]
    state, outcome = _STATES[status.status]
    error = None
    if status.status == "MAX_RECOVERY_ATTEMPTS_EXCEEDED":
        error = JobError(type="WorkerDied", detail="the worker died on this job again and again")
    elif status.error is not None:
        name = getattr(status.error, "name", type(status.error).__name__)
        error = JobError(type=name, detail=printable(str(status.error)))
    return Job(
        id=status.workflow_id,
        pipeline=spec["pipeline"],
        state=state,
        outcome=outcome,
        capture=spec["capture"],
        model=spec["model"],
        options=spec["options"],
        progress=read_progress(Model(spec["model"]), status.workflow_id),
        error=error,
        created=_time(status.created_at) or "",
        started=_time(status.dequeued_at),
        finished=_time(status.completed_at),
    )


def _time(milliseconds: int | None) -> str | None:
    if milliseconds is None:
        return None
    return datetime.fromtimestamp(milliseconds / 1000, UTC).isoformat(timespec="milliseconds")

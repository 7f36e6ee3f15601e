"""The job queue as the service and the command line use it: no worker code, no HTTP."""

from __future__ import annotations

import fcntl
import logging
import math
import os
import re
import secrets
import threading
import time
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from urllib.parse import quote

from dbos import (
    DBOS,
    DBOSClient,
    DBOSPortableJSONSerializer,
    EnqueueOptions,
    WorkflowStatus,
)
from sqlalchemy import make_url

from reconstruction import Model
from reconstruction.reading import printable
from stage_service.jobs.pipelines import PIPELINES, RENDERING
from stage_service.jobs.progress import read_progress
from stage_service.jobs.records import Job, JobError, JobOutcome, JobState, PipelineRequest
from stage_service.jobs.slots import Namespace
from stage_service.jobs.sqlite_file import set_aside_if_broken
from stage_service.records.logs import CAUSES, Folded

log = logging.getLogger("hairstage.jobs")
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
"""Connection time-out of a PostgreSQL server."""
SILENT_S = 20
"""Time-out of its acknowledgements."""
STATEMENT_S = 8
"""Time-out of the service's statements; a worker's have none."""
NO_REPLY_S = 10.0
"""While a request has had no response for this long, no other is sent: each blocks a thread."""
CAUSE = "the job database"
"""The cause in the log."""
LIBRARIES = Folded(
    log, CAUSE, {"dbos", "sqlalchemy"}, {"psycopg", "sqlalchemy", "sqlite3", "connection"}
)
"""They log each failure of each thread, with tracebacks: 130 lines per second."""
_RAISED = re.compile(r"^(\([a-z_0-9.]+\.\w+\)|DBOS Error \d+:) ")
"""The class of an error, a prefix by SQLAlchemy or DBOS."""
_CONNECTION = re.compile(r"^connection .* failed: (FATAL: +)?")
"""The prefix by libpq of a failed connection."""
_MEANWHILE = "Captures and blackout work meanwhile; jobs resume by themselves once it is back."


class NoSuchJob(LookupError):
    """No job has this id."""


class JobsUnavailable(RuntimeError):
    """The job database does not respond, or cannot be used."""


def database_url(root: Path, statement_s: float | None = None) -> str:
    """The queue's database: `HAIRSTAGE_DATABASE_URL` (PostgreSQL), else SQLite in `root`.

    `statement_s` is PostgreSQL's statement time-out. Parameters in the URL take precedence.
    """
    url = os.environ.get("HAIRSTAGE_DATABASE_URL")
    if not url:
        return f"sqlite:///{root.resolve()}/{SQLITE}"
    if not url.startswith("postgres"):
        return url
    limits = {
        "connect_timeout": f"{CONNECT_S}",
        "tcp_user_timeout": f"{SILENT_S * 1000}",
        "keepalives_idle": f"{SILENT_S}",
    }
    if statement_s is not None:
        limits["options"] = f"-c statement_timeout={statement_s * 1000:.0f}"
    for name, value in limits.items():
        if f"{name}=" not in url:
            url += f"{'&' if '?' in url else '?'}{name}={quote(value)}"
    return url


@dataclass(frozen=True)
class Waiting:
    """Numbers of queued and running jobs, and how long the oldest queued one has waited."""

    queued: int
    running: int
    oldest_s: float


def new_job_id() -> str:
    """A unique id that sorts by time."""
    return f"job-{datetime.now(UTC):%Y%m%d-%H%M%S}-{secrets.token_hex(3)}"


class JobQueue:
    """Enqueue, read and cancel jobs; works whether or not a worker is running.

    Constructing connects to nothing; calls connect if needed and raise `JobsUnavailable` while the
    database does not respond. A broken SQLite file is renamed and replaced; `set_aside` reports it.
    """

    def __init__(self, root: Path, *, gpu_workers: bool = False) -> None:
        self._root, self._gpu_workers = root, gpu_workers
        self._lock = threading.Lock()
        self._client: DBOSClient | None = None
        self._names: Namespace | None = None
        self._problem: str | None = None
        self._calls: dict[object, float] = {}  # start of each request under way
        self.set_aside: str | None = None

    @property
    def names(self) -> Namespace:
        """This root's names in a database that other roots may share."""
        if self._names is None:
            self._root.mkdir(parents=True, exist_ok=True)
            self._names = Namespace(self._root)
        return self._names

    @property
    def problem(self) -> str | None:
        """Why the database cannot be used, as a sentence; None if it can."""
        return self._silence() or self._problem

    def connect(self) -> None:
        """Open the database, now. Raises `JobsUnavailable`."""
        with self._database():
            pass

    def close(self) -> None:
        """Disconnect; waits at most 1 s for a connection that is being opened."""
        if self._lock.acquire(timeout=1.0):
            client, self._client = self._client, None
            self._lock.release()
            if client is not None:
                client.destroy()

    def submit(self, request: PipelineRequest, capture: Path, model: Model, *, job: str) -> Job:
        """Enqueue a job, or return the existing job of this id."""
        spec = {
            "pipeline": request.name,
            "capture": self._stored(capture),
            "model": self._stored(model.path),
            "options": request.options.to_dict(),
            "retries": request.retries,
        }
        renders = not RENDERING.isdisjoint(PIPELINES[request.name])
        options: EnqueueOptions = {
            "workflow_name": WORKFLOW,
            "queue_name": self.names.queue(renders and self._gpu_workers),
            "workflow_id": self.names.workflow(job),
            "priority": request.priority + 1,
        }
        if request.timeout_s is not None:
            options["workflow_timeout"] = request.timeout_s
        with self._database() as client:
            client.enqueue(options, spec)
        return self.get(job)

    def get(self, job: str) -> Job:
        """The job's present state. Raises `NoSuchJob`."""
        with self._database() as client:
            found = client.list_workflows(workflow_ids=[self.names.workflow(job)])
        if not found:
            raise NoSuchJob(f"there is no job {job!r}")
        return self._job(found[0])

    def all(self, *, limit: int = 200, offset: int = 0) -> list[Job]:
        """The latest `limit` jobs after the `offset` newest, newest first."""
        with self._database() as client:
            found = client.list_workflows(name=WORKFLOW, sort_desc=True, limit=limit, offset=offset)
        return [self._job(w) for w in found]

    def several(self, jobs: Collection[str]) -> list[Job]:
        """Those of these jobs that exist, in any order."""
        with self._database() as client:
            found = client.list_workflows(workflow_ids=[self.names.workflow(job) for job in jobs])
        return [self._job(w) for w in found]

    def ids(self) -> set[str]:
        """The ids of all jobs."""
        with self._database() as client:
            found = client.list_workflows(name=WORKFLOW, load_input=False, load_output=False)
        return {self.names.job(w.workflow_id) for w in found}

    def waiting(self) -> Waiting:
        """Counts of jobs that are not done."""
        going = ["PENDING", "ENQUEUED", "DELAYED"]
        with self._database() as client:
            found = client.list_workflows(
                name=WORKFLOW, status=going, load_input=False, load_output=False
            )
        queued = [w.created_at or 0 for w in found if w.status != "PENDING"]
        oldest = time.time() - min(queued) / 1000 if queued else 0.0
        return Waiting(len(queued), len(found) - len(queued), max(0.0, oldest))

    def executors(self) -> set[str]:
        """The names of the workers with running jobs, dead ones included."""
        with self._database() as client:
            found = client.list_workflows(
                name=WORKFLOW, status="PENDING", load_input=False, load_output=False
            )
        return {w.executor_id for w in found if w.executor_id is not None}

    def at_work_on(self, model: Model) -> str | None:
        """The id of a queued or running job that writes this model."""
        path = self._stored(model.path)
        with self._database() as client:
            for state in ("PENDING", "ENQUEUED", "DELAYED"):
                for found in client.list_workflows(name=WORKFLOW, status=state):
                    if found.input is not None and found.input["args"][0]["model"] == path:
                        return self.names.job(found.workflow_id)
        return None

    def cancel(self, job: str) -> Job:
        """Cancel a job; a step that runs stops at its next progress call. A done job stays done."""
        if self.get(job).state != "done":
            with self._database() as client:
                client.cancel_workflow(self.names.workflow(job))
        return self.get(job)

    def cancelled(self, job: str) -> bool:
        """Whether the job was cancelled."""
        ids = [self.names.workflow(job)]
        with self._database() as client:
            found = client.list_workflows(workflow_ids=ids, load_input=False, load_output=False)
        return bool(found) and found[0].status == "CANCELLED"

    def path(self, stored: str) -> Path:
        """The path of a job's capture or model on this machine."""
        return self._root.resolve() / stored

    def _stored(self, path: Path) -> str:
        """A path as jobs store it: relative to the root where it is inside."""
        path, root = path.resolve(), self._root.resolve()
        return str(path.relative_to(root) if path.is_relative_to(root) else path)

    @contextmanager
    def _database(self) -> Iterator[DBOSClient]:
        """The open database; any error becomes `JobsUnavailable`."""
        if (silent := self._silence()) is not None:
            CAUSES.failed(log, CAUSE, silent)
            raise JobsUnavailable(silent)
        call = object()
        self._calls[call] = time.monotonic()
        try:
            if not self._lock.acquire(timeout=NO_REPLY_S):
                raise TimeoutError("it is still being connected to")
            try:
                if self._client is None:
                    self._client = self._open()
                client = self._client
            finally:
                self._lock.release()
            yield client
        except Exception as error:
            self._problem = self._sentence(_reason(error))
            CAUSES.failed(log, CAUSE, f"{type(error).__name__}: {_first_line(error)}")
            raise JobsUnavailable(self._problem) from error
        finally:
            del self._calls[call]
        self._problem = None
        CAUSES.over(log, CAUSE)

    def _silence(self) -> str | None:
        """Why no request may be sent now; None if one may."""
        waits = time.monotonic() - min(list(self._calls.values()), default=math.inf)
        if waits < NO_REPLY_S:
            return None
        return self._sentence(f"a request has had no response for {waits:.0f} s")

    def _sentence(self, reason: str) -> str:
        """A sentence for operators."""
        url = make_url(database_url(self._root))
        if url.get_backend_name() == "sqlite":
            return f"The job database {url.database} cannot be used: {reason}. {_MEANWHILE}"
        host = url.host or url.query.get("host") or "this machine"
        port = url.port or url.query.get("port") or 5432
        return f"The job database at {host}:{port} does not respond: {reason}. {_MEANWHILE}"

    def _open(self) -> DBOSClient:
        names = self.names
        logging.getLogger("dbos").setLevel(logging.WARNING)
        url = database_url(self._root, STATEMENT_S)
        if url.startswith("sqlite:///"):
            file = Path(url.removeprefix("sqlite:///"))
            # Service and worker may open a broken file at the same time.
            with file.with_suffix(".lock").open("a") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)
                self.set_aside = set_aside_if_broken(file)
                DBOS.migrate(url)
        else:
            DBOS.migrate(database_url(self._root))
        return DBOSClient(
            system_database_url=url,
            serializer=DBOSPortableJSONSerializer(),
            application_name=names.application,
            retry_connection_errors=False,
            observability_query_timeout_sec=STATEMENT_S,  # of lists
        )

    def _job(self, status: WorkflowStatus) -> Job:
        assert status.input is not None
        spec: dict[str, Any] = status.input["args"][0]
        state, outcome = _STATES[status.status]
        error, job = None, self.names.job(status.workflow_id)
        # Milliseconds; SQLite's clock has a resolution of 1 s.
        deadline, end = status.workflow_deadline_epoch_ms, status.completed_at
        if status.status == "MAX_RECOVERY_ATTEMPTS_EXCEEDED":
            error = JobError(type="WorkerDied", detail="its worker died repeatedly: see its log")
        elif status.status == "CANCELLED" and deadline and end and end > deadline - 1000:
            limit = (status.workflow_timeout_ms or 0) / 1000
            outcome, detail = "failed", f"it took longer than its timeout_s of {limit:g} s"
            error = JobError(type="JobTimeout", detail=detail)
        elif status.error is not None:
            name = getattr(status.error, "name", type(status.error).__name__)
            error = JobError(type=name, detail=printable(str(status.error)))
        model = self.path(spec["model"])
        return Job(
            id=job,
            pipeline=spec["pipeline"],
            state=state,
            outcome=outcome,
            capture=str(self.path(spec["capture"])),
            model=str(model),
            options=spec["options"],
            priority=(status.priority or 1) - 1,  # DBOS counts from 1
            retries=spec["retries"],
            timeout_s=None if (ms := status.workflow_timeout_ms) is None else ms / 1000,
            progress=read_progress(Model(model), job),
            error=error,
            created=_time(status.created_at) or "",
            started=_time(status.dequeued_at),
            finished=_time(status.completed_at),
        )


def _reason(error: Exception) -> str:
    """The database's own message, without the libraries' prefixes."""
    said = _CONNECTION.sub("", _RAISED.sub("", _first_line(error))).strip().rstrip(".")
    if "statement timeout" in said:
        return f"a request took longer than {STATEMENT_S} s"
    return said or type(error).__name__


def _first_line(error: Exception) -> str:
    return next(iter(str(error).splitlines()), "")


def _time(milliseconds: int | None) -> str | None:
    if milliseconds is None:
        return None
    return datetime.fromtimestamp(milliseconds / 1000, UTC).isoformat(timespec="milliseconds")

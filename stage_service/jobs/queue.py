"""The job queue as the service and the command line use it: no worker code, no HTTP."""

from __future__ import annotations

import logging
import os
import secrets
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from dbos import DBOS, DBOSClient, DBOSPortableJSONSerializer, WorkflowStatus

from reconstruction import Model
from stage_service.jobs.progress import read_progress
from stage_service.jobs.records import Job, JobError, JobOutcome, JobState, PipelineRequest

APP = "hairstage"
QUEUE = "jobs"
WORKFLOW = "hairstage_job"

_STATES: dict[str, tuple[JobState, JobOutcome | None]] = {
    "DELAYED": ("queued", None),
    "ENQUEUED": ("queued", None),
    "PENDING": ("running", None),
    "SUCCESS": ("done", "succeeded"),
    "ERROR": ("done", "failed"),
    "MAX_RECOVERY_ATTEMPTS_EXCEEDED": ("done", "failed"),
    "CANCELLED": ("done", "cancelled"),
}


class NoSuchJob(LookupError):
    """No job has this id."""


def database_url(root: Path) -> str:
    """Where the queue lives: `HAIRSTAGE_DATABASE_URL` (PostgreSQL), else SQLite in `root`."""
    return os.environ.get("HAIRSTAGE_DATABASE_URL") or f"sqlite:///{root.resolve()}/jobs.sqlite"


def new_job_id() -> str:
    """An id that no other job has, and that sorts by time."""
    return f"job-{datetime.now(UTC):%Y%m%d-%H%M%S}-{secrets.token_hex(3)}"


class JobQueue:
    """Enqueue, read and cancel jobs; works whether or not a worker is running."""

    def __init__(self, root: Path) -> None:
        root.mkdir(parents=True, exist_ok=True)
        logging.getLogger("dbos").setLevel(logging.WARNING)
        DBOS.migrate(database_url(root))
        self._client = DBOSClient(
            system_database_url=database_url(root),
            serializer=DBOSPortableJSONSerializer(),
            application_name=APP,
        )

    def close(self) -> None:
        """Let go of the database."""
        self._client.destroy()

    def submit(self, request: PipelineRequest, capture: Path, model: Model, *, job: str) -> Job:
        """Put a job on the queue; where there is a job of this id already, return that one."""
        spec = {
            "pipeline": request.name,
            "capture": str(capture.resolve()),
            "model": str(model.path.resolve()),
            "options": request.options.to_dict(),
        }
        self._client.enqueue(
            {"workflow_name": WORKFLOW, "queue_name": QUEUE, "workflow_id": job}, spec
        )
        return self.get(job)

    def get(self, job: str) -> Job:
        """The job's present state. Raises `NoSuchJob`."""
        found = self._client.list_workflows(workflow_ids=[job])
        if not found:
            raise NoSuchJob(f"there is no job {job!r}")
        return _job(found[0])

    def all(self, *, limit: int = 200) -> list[Job]:
        """The latest `limit` jobs, newest first."""
        return [
            _job(w) for w in self._client.list_workflows(name=WORKFLOW, sort_desc=True, limit=limit)
        ]

    def cancel(self, job: str) -> Job:
        """Cancel a job; a step that runs stops at its next progress call. A done job stays done."""
        if self.get(job).state != "done":
            self._client.cancel_workflow(job)
        return self.get(job)

    def cancelled(self, job: str) -> bool:
        """Whether the job was cancelled: what a running step asks."""
        found = self._client.list_workflows(workflow_ids=[job], load_input=False, load_output=False)
        return bool(found) and found[0].status == "CANCELLED"


def _job(status: WorkflowStatus) -> Job:
    assert status.input is not None
    spec: dict[str, Any] = status.input["args"][0]
    state, outcome = _STATES[status.status]
    error = None
    if status.status == "MAX_RECOVERY_ATTEMPTS_EXCEEDED":
        error = JobError(type="WorkerDied", detail="the worker died on this job again and again")
    elif status.error is not None:
        name = getattr(status.error, "name", type(status.error).__name__)
        error = JobError(type=name, detail=str(status.error))
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

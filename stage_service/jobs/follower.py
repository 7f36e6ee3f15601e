"""The thread that talks to the job database by itself, so that nothing else has to wait for it."""

from __future__ import annotations

import logging
import threading
import time
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from reconstruction import Model
from stage_service.acquisition.states import CaptureStatus
from stage_service.jobs.queue import JobQueue, JobsUnavailable, Waiting
from stage_service.jobs.records import Job, PipelineRequest
from stage_service.records.audit import SERVICE, AuditLog
from stage_service.records.events import EventLog
from stage_service.records.logs import CAUSES

log = logging.getLogger("hairstage.jobs")
POLL_S = 0.5
COUNT_S = 5.0
"""How old the count of jobs that wait may be."""
FOLLOWING = "following the jobs"
"""As the log names what is wrong with that."""
JOB_END = "job.end"
MOST_ENDS = 1000
"""Jobs, and lines of the audit log, that are looked at for ends that nobody has recorded."""


@dataclass(frozen=True)
class _Wish:
    """The pipeline that a capture was asked to be followed by; `fresh`: it has just completed."""

    pipeline: PipelineRequest
    capture: Path
    fresh: bool


class JobFollower:
    """Enqueues what completed captures were asked to be followed by, and tells what becomes of
    jobs. While the database is away it tries again."""

    def __init__(self, root: Path, queue: JobQueue, events: EventLog, audit: AuditLog) -> None:
        self._root, self._queue, self._events, self._audit = root, queue, events, audit
        self.waiting: Waiting | None = None
        self.waiting_at = 0.0
        self._lock = threading.Lock()
        self._pending: dict[str, _Wish] = {}  # by capture: its job may not exist yet
        self._certain: set[str] = set()  # captures whose job is there
        self._wake = threading.Event()
        self._closed = False
        self._seen: dict[str, Job] = {}  # the newest, and whatever is not done
        self._audited: set[str] | None = None  # jobs that had ended before
        self._thread = threading.Thread(target=self._run, name="job-events", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def close(self) -> None:
        """End; a database that hangs is not waited for."""
        self._closed = True
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(timeout=5)

    def follow_up(self, status: CaptureStatus, *, fresh: bool = True) -> None:
        """Take note of a capture that completed. One that is not `fresh` may have its job."""
        asked = status.request.get("pipeline")
        if asked is None:
            return
        try:
            pipeline = PipelineRequest.model_validate(asked)
        except ValidationError as error:  # a capture of another version must not stop this one
            log.warning("%s: its pipeline cannot be run: %s", status.path, error)
            return
        self._pending[status.id] = _Wish(pipeline, Path(status.path), fresh)
        self._wake.set()

    def is_pending(self, capture: str) -> bool:
        """Whether the capture's job is still to be enqueued."""
        return capture in self._pending

    def job_after(self, capture: str) -> str | None:
        """The id of the job that follows the capture, there already or about to be."""
        there = capture in self._certain or capture in self._pending
        return job_of(capture) if there else None

    def enqueue_now(self, job: str) -> Job | None:
        """The job that is still owed under this id. Raises `JobsUnavailable`."""
        capture = job.removeprefix(job_of(""))
        with self._lock:
            wish = self._pending.get(capture)
            return None if wish is None else self._enqueue(capture, wish)

    def _run(self) -> None:
        while not self._closed:
            self._wake.wait(POLL_S)
            self._wake.clear()
            if self._closed:
                return
            try:
                self._enqueue_pending()
                self._tell()
                if time.monotonic() - self.waiting_at > COUNT_S:
                    self.waiting, self.waiting_at = self._queue.waiting(), time.monotonic()
                CAUSES.over(log, FOLLOWING)
            except JobsUnavailable:  # which the queue has logged
                pass
            except Exception as error:  # the thread goes on
                CAUSES.failed(log, FOLLOWING, error, error)

    def _enqueue_pending(self) -> None:
        if not self._pending:
            return
        there = self._queue.ids()
        with self._lock:
            for capture, wish in list(self._pending.items()):
                begun = (self._root / "models" / capture).exists()
                if job_of(capture) in there:
                    self._certain.add(capture)
                    del self._pending[capture]
                elif begun and not wish.fresh:
                    log.warning("%s: its job is lost; the model stays as it is", wish.capture)
                    del self._pending[capture]
                else:
                    self._enqueue(capture, wish)

    def _enqueue(self, capture: str, wish: _Wish) -> Job:
        # One id per capture: enqueuing again after a crash is not a second job.
        model = Model(self._root / "models" / capture)
        job = self._queue.submit(wish.pipeline, wish.capture, model, job=job_of(capture))
        self._certain.add(capture)
        self._pending.pop(capture, None)
        self._audit.record(SERVICE, "job.submit", job.id, detail=f"{job.pipeline} on {capture}")
        return job

    def _tell(self) -> None:
        """Publish what has changed; ends are audited, those since the service last looked, too."""
        if self._audited is None:
            ends = [a for a in self._audit.latest(MOST_ENDS) if a.action == JOB_END]
            self._audited = {action.subject for action in ends}
        newest = self._queue.all(limit=50 if self._seen else MOST_ENDS)
        found = {job.id: job for job in reversed(newest)}
        older = [i for i, job in self._seen.items() if job.state != "done" and i not in found]
        if older:
            found.update({job.id: job for job in self._queue.several(older)})
        for job in found.values():
            before = self._seen.get(job.id)
            if before is None or (before.state, before.outcome) != (job.state, job.outcome):
                if job.state == "done" and job.id not in self._audited:
                    self._audited.add(job.id)
                    self._audit.record(SERVICE, JOB_END, job.id, str(job.outcome), _end(job))
                data = {"job": job.id, "state": job.state, "outcome": job.outcome}
                self._events.publish("job.state", data)
            if job.progress is not None and (before is None or before.progress != job.progress):
                data = {"job": job.id, **job.progress.model_dump(mode="json")}
                self._events.publish("job.progress", data)
        self._seen = found


def _end(job: Job) -> str:
    why = "" if job.error is None else f": {job.error.type}: {job.error.detail}"
    return f"{job.pipeline} on {Path(job.capture).name}, at {job.finished}{why}"


def job_of(capture_id: str) -> str:
    """The id of the job that a capture's completion enqueues."""
    return f"job-{capture_id}"

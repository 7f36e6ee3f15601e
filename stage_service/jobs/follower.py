"""The thread that polls the job database, so that nothing else waits for it."""

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
"""Largest age of the count of queued jobs, in seconds."""
FOLLOWING = "following the jobs"
"""The cause in the log."""
JOB_END = "job.end"
MOST_ENDS = 1000
"""Jobs, and lines of the audit log, that are searched for ends without a record."""


@dataclass(frozen=True)
class _Wish:
    """The pipeline requested for a capture; `fresh`: the capture has just completed."""

    pipeline: PipelineRequest
    capture: Path
    fresh: bool


class JobFollower:
    """Enqueues the pipelines requested for completed captures, and publishes and audits jobs'
    progress and ends. Retries while the database is unavailable."""

    def __init__(self, root: Path, queue: JobQueue, events: EventLog, audit: AuditLog) -> None:
        self._root, self._queue, self._events, self._audit = root, queue, events, audit
        self.waiting: Waiting | None = None
        self.waiting_at = 0.0
        self._lock = threading.Lock()
        self._pending: dict[str, _Wish] = {}  # by capture; its job may exist
        self._certain: set[str] = set()  # captures whose job exists
        self._wake = threading.Event()
        self._closed = False
        self._known: dict[str, Job] = {}  # the newest jobs, and those not done
        self._new: set[str] = set()
        self._audited: set[str] | None = None  # jobs whose end is recorded
        self._thread = threading.Thread(target=self._run, name="job-events", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def close(self) -> None:
        """End the thread; waits 5 s for a database that hangs."""
        self._closed = True
        self._wake.set()
        if self._thread.is_alive():
            self._thread.join(timeout=5)

    def follow_up(self, status: CaptureStatus, *, fresh: bool = True) -> None:
        """Enqueue the pipeline of a completed capture; one that is not `fresh` may have its job."""
        requested = status.request.get("pipeline")
        if requested is None:
            return
        try:
            pipeline = PipelineRequest.model_validate(requested)
        except ValidationError as error:  # a capture of another version
            log.warning("%s: its pipeline cannot be run: %s", status.path, error)
            return
        self._pending[status.id] = _Wish(pipeline, Path(status.path), fresh)
        self._wake.set()

    def is_pending(self, capture: str) -> bool:
        """Whether the capture's job is still to be enqueued."""
        return capture in self._pending

    def job_after(self, capture: str) -> str | None:
        """The id of the capture's job, enqueued or pending."""
        there = capture in self._certain or capture in self._pending
        return job_of(capture) if there else None

    def follow(self, job: str) -> None:
        """Follow a new job; after the clock was set back it is not among the newest."""
        self._new.add(job)

    def enqueue_now(self, job: str) -> Job | None:
        """Enqueue the pending job of this id; None without one. Raises `JobsUnavailable`."""
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
                self._publish()
                if time.monotonic() - self.waiting_at > COUNT_S:
                    self.waiting, self.waiting_at = self._queue.waiting(), time.monotonic()
                CAUSES.over(log, FOLLOWING)
            except JobsUnavailable:  # which the queue has logged
                pass
            except Exception as error:  # any error: the thread continues
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
                    log.warning("%s: its job is lost; the model is kept as it is", wish.capture)
                    del self._pending[capture]
                else:
                    self._enqueue(capture, wish)

    def _enqueue(self, capture: str, wish: _Wish) -> Job:
        # One id per capture: enqueuing again after a crash makes no second job.
        model = Model(self._root / "models" / capture)
        job = self._queue.submit(wish.pipeline, wish.capture, model, job=job_of(capture))
        self._certain.add(capture)
        self._pending.pop(capture, None)
        self.follow(job.id)
        self._audit.record(SERVICE, "job.submit", job.id, detail=f"{job.pipeline} on {capture}")
        return job

    def _publish(self) -> None:
        """Publish changes; record ends in the audit log, also those while no service ran."""
        if self._audited is None:
            ends = [a for a in self._audit.latest(MOST_ENDS) if a.action == JOB_END]
            self._audited = {action.subject for action in ends}
        newest = self._queue.all(limit=50 if self._known else MOST_ENDS)
        found = {job.id: job for job in reversed(newest)}
        going = [i for i, job in self._known.items() if job.state != "done"]
        older = {*going, *self._new.copy()} - found.keys()
        if older:
            found.update({job.id: job for job in self._queue.several(older)})
        for job in found.values():
            before = self._known.get(job.id)
            if before is None or (before.state, before.outcome) != (job.state, job.outcome):
                if job.state == "done" and job.id not in self._audited:
                    self._audited.add(job.id)
                    self._audit.record(SERVICE, JOB_END, job.id, str(job.outcome), _end(job))
                data = {"job": job.id, "state": job.state, "outcome": job.outcome}
                self._events.publish("job.state", data)
            if job.progress is not None and (before is None or before.progress != job.progress):
                data = {"job": job.id, **job.progress.model_dump(mode="json")}
                self._events.publish("job.progress", data)
        self._known = found
        self._new -= found.keys()


def _end(job: Job) -> str:
    why = "" if job.error is None else f": {job.error.type}: {job.error.detail}"
    return f"{job.pipeline} on {Path(job.capture).name}, at {job.finished}{why}"


def job_of(capture_id: str) -> str:
    """The id of a capture's job."""
    return f"job-{capture_id}"

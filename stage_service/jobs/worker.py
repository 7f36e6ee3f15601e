"""The worker process: takes jobs off the queue and runs their steps.

DBOS checkpoints every step: after a worker's death, SIGKILL included, the next worker resumes its
jobs at the step that was under way.
"""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from dbos import DBOS, DBOSPortableJSONSerializer
from dbos import error as dbos_error

from reconstruction import Model, parse_options
from stage_service.jobs.pipelines import PIPELINES, STEPS_VERSION
from stage_service.jobs.progress import JobCancelled, JobInterrupted, StepProgress, WorkerStopping
from stage_service.jobs.queue import WORKFLOW, JobQueue, JobsUnavailable, database_url
from stage_service.jobs.records import JobOptions
from stage_service.jobs.slots import BEAT_S, WorkerSlot, hold_dead
from stage_service.jobs.steps import STEPS, StepContext
from stage_service.records.logs import CAUSES, about
from stage_service.signals import taken
from stage_service.stopping import Ending, Step, end_all

log = logging.getLogger("hairstage.worker")

CANCEL_S = 10.0
"""A cancelled step that has not stopped by then, as in native code, ends with its process."""
MOST_ATTEMPTS = 20
"""A job fails after its worker died or was stopped this often."""
DATABASE_S = 3.0
"""Seconds that a stopping worker waits for the job database."""
LOOK_S = 5.0
"""Interval at which a worker checks for dead ones."""
LOOKING = "checking for dead workers"
"""The cause in the log."""
RETRY_S = 5.0
"""Seconds before a failed step is retried."""


class Worker:
    """Runs the steps of jobs, at most `concurrency` at a time, until `stop`."""

    def __init__(self, root: Path, concurrency: int) -> None:
        self.queue = JobQueue(root)
        self.queue.connect()
        self.slot = WorkerSlot(root)
        self._root = root
        self._stopping = threading.Event()
        # DBOS no longer counts a cancelled job, whose thread runs until its next progress call.
        self._slots = threading.BoundedSemaphore(concurrency)
        self._under_way: set[str] = set()

    def stop(self) -> None:
        """Stop running steps at their next progress call; another worker resumes them."""
        self._stopping.set()

    def run_job(self, spec: dict[str, Any]) -> dict[str, Any]:
        """The workflow: every step of the pipeline in order, each a checkpoint."""
        steps = PIPELINES[spec["pipeline"]]
        done: dict[str, Any] = {}
        for step in steps:
            done[step] = DBOS.run_step({"name": step}, self._run_step, spec, step, dict(done))
        return {step: result["seconds"] for step, result in done.items()}

    def _run_step(self, spec: dict[str, Any], step: str, previous: dict[str, Any]) -> Any:
        assert DBOS.workflow_id is not None
        job = self.queue.names.job(DBOS.workflow_id)
        model = Model(self.queue.path(spec["model"])).create()
        progress = StepProgress(
            model, job, step, PIPELINES[spec["pipeline"]], lambda: self._interrupted(job)
        )
        options = parse_options(JobOptions, spec["options"])
        capture = self.queue.path(spec["capture"])
        context = StepContext(capture, model, options, progress, previous)
        with self._slots, about(job=job, capture=capture.name):
            log.info("%s: %s begins", job, step)
            start = time.perf_counter()
            self._under_way.add(job)
            try:
                figures = self._tried(context, step, job, spec["retries"])
            except JobCancelled as cancelled:
                log.info("%s: %s stopped, the job was cancelled", job, step)
                raise dbos_error.DBOSWorkflowCancelledError(
                    f"job {job} was cancelled"
                ) from cancelled
            except Exception:
                log.exception("%s: %s failed", job, step)
                raise
            finally:
                self._under_way.discard(job)
            seconds = time.perf_counter() - start
        log.info("%s: %s took %.1f s", job, step, seconds)
        return {"seconds": seconds, "figures": figures}

    def _tried(self, context: StepContext, step: str, job: str, retries: int) -> Any:
        """The result of the first of `1 + retries` tries that does not fail."""
        while True:
            try:
                context.progress(step, 0.0)
                figures = STEPS[step](context)
                context.progress(step, 1.0)
                return figures
            except Exception:
                if retries == 0:
                    raise
                retries -= 1
                log.exception("%s: %s failed and is retried", job, step)
            until = time.monotonic() + RETRY_S
            while time.monotonic() < until:
                context.progress(f"{step} failed and is retried", 0.0)
                time.sleep(RETRY_S / 20)

    def look_after(self, take_over: str | None = None) -> None:
        """Send heartbeats, and resume the jobs of this root's dead workers on this machine, and of
        all workers on the machine `take_over`, which is known to be dead."""
        checked = 0.0
        while not self._stopping.wait(BEAT_S):
            try:
                self.slot.beat()
                if time.monotonic() - checked > LOOK_S:
                    checked = time.monotonic()
                    self._take_up(take_over)
                CAUSES.over(log, LOOKING)
            except JobsUnavailable:  # which the queue has logged
                pass
            except Exception as error:
                CAUSES.failed(log, LOOKING, error, None if isinstance(error, OSError) else error)

    def _take_up(self, take_over: str | None) -> None:
        for executor in self.queue.executors() - {self.queue.names.executor(self.slot)}:
            dead = hold_dead(self._root, executor)
            if dead is None and executor.split("/")[1:2] != [take_over]:
                continue
            try:
                log.warning("%s is dead: its jobs are resumed", executor)
                DBOS._recover_pending_workflows([executor])
            finally:
                if dead is not None:
                    dead.close()

    def watch(self) -> None:
        """Restart the process in place once a cancelled step has not stopped in time.

        Other jobs of this worker resume at their present step.
        """
        since: dict[str, float] = {}
        while not self._stopping.wait(CANCEL_S / 10):
            now = time.monotonic()
            going = list(self._under_way)
            late = [job for job in going if isinstance(self._interrupted(job), JobCancelled)]
            since = {job: since.get(job, now) for job in late}
            if any(now - begun > CANCEL_S for begun in since.values()):
                log.warning("%s: cancelled, not stopped: the worker restarts", ", ".join(late))
                logging.shutdown()
                os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])

    def _interrupted(self, job: str) -> JobInterrupted | None:
        if self._stopping.is_set():
            return WorkerStopping("the worker is stopping")
        try:
            return JobCancelled(job) if self.queue.cancelled(job) else None
        except JobsUnavailable:  # the step continues
            return None


def run_worker(
    root: Path,
    *,
    concurrency: int = 1,
    gpu: bool = False,
    take_over: str | None = None,
    ready: Callable[[str], None] = lambda _name: None,
) -> None:
    """Serve a queue of `root` until SIGTERM or SIGINT; calls `ready` with this worker's name.

    With `gpu` the queue of jobs that render, for a service with `gpu_workers`. `take_over` is a
    dead machine of this root, whose workers' jobs are resumed. Ends the process; the next worker
    resumes a step under way.
    """
    worker = Worker(root, concurrency)
    names = worker.queue.names
    # Instead of DBOS's own handler, which has another format and repeats causes.
    logging.getLogger("dbos").addHandler(logging.NullHandler())
    logging.getLogger("dbos").addFilter(_not_repeated)
    DBOS(
        config={
            "name": names.application,
            "system_database_url": database_url(root),
            "serializer": DBOSPortableJSONSerializer(),
            "application_version": names.version(STEPS_VERSION),
            "executor_id": names.executor(worker.slot),
            "log_level": "WARNING",
        }
    )

    @DBOS.workflow(name=WORKFLOW, max_recovery_attempts=MOST_ATTEMPTS)
    def job(spec: dict[str, Any]) -> dict[str, Any]:
        return worker.run_job(spec)

    stop = taken(signal.SIGTERM, signal.SIGINT)
    # Before the database is used, which may hang.
    ends = threading.Thread(target=_end, args=(worker, stop), name="stop", daemon=True)
    ends.start()
    queue = names.queue(gpu)
    DBOS.listen_queues([queue])
    DBOS.launch()
    for work in (worker.watch, partial(worker.look_after, take_over)):
        threading.Thread(target=work, daemon=True).start()
    DBOS.register_queue(queue, worker_concurrency=concurrency, polling_interval_sec=0.2)
    ready(worker.slot.name)
    ends.join()


def _end(worker: Worker, stop: Callable[[], None]) -> None:
    """End this process once `stop` returns. Step threads may be in native code and are not waited
    for; the next worker needs nothing of theirs."""
    stop()
    left: list[str] = []
    ending = Ending(left)
    worker.stop()
    end_all([Step("the job database", DBOS.destroy, DATABASE_S)], left)
    ending.now()


def _not_repeated(record: logging.LogRecord) -> bool:
    """DBOS logs the end of every failed or cancelled job as an error of its own."""
    return not record.getMessage().startswith("Exception encountered in background workflow")

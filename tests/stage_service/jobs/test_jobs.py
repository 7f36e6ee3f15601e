"""Jobs: states, cancellation, and what is left when a worker dies."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from waiting import until

from reconstruction import Model
from stage_service.jobs.progress import JobCancelled, JobInterrupted, StepProgress, read_progress
from stage_service.jobs.queue import JobQueue, new_job_id
from stage_service.jobs.records import Job, PipelineRequest
from stage_service.jobs.slots import WorkerSlot, worker_statuses

WORKER = Path(__file__).with_name("job_worker.py")


def start_worker(root: Path) -> subprocess.Popen[str]:
    worker = subprocess.Popen(
        [sys.executable, str(WORKER), str(root)], stdout=subprocess.PIPE, text=True
    )
    assert worker.stdout is not None
    assert worker.stdout.readline() == "worker-0\n"
    return worker


def end(worker: subprocess.Popen[str]) -> None:
    worker.kill()
    worker.wait()
    assert worker.stdout is not None
    worker.stdout.close()


@pytest.fixture
def queue(tmp_path: Path) -> Iterator[JobQueue]:
    queue = JobQueue(tmp_path)
    yield queue
    queue.close()


def worker_is_alive(root: Path) -> bool:
    return any(worker.alive for worker in worker_statuses(root))


def submit(queue: JobQueue, root: Path, pipeline: str = "reconstruct") -> Job:
    job = new_job_id()
    request = PipelineRequest(name=pipeline)
    return queue.submit(request, root / "capture", Model(root / job), job=job)


def test_unknown_pipelines_and_options_are_refused_by_name() -> None:
    with pytest.raises(ValueError, match=r"no pipeline 'lightplanes'.*'light_planes'"):
        PipelineRequest(name="lightplanes")
    with pytest.raises(ValueError, match="held_out"):
        PipelineRequest.model_validate({"name": "fit", "options": {"held_out": []}})


def test_a_killed_workers_job_resumes_at_its_current_step(queue: JobQueue, tmp_path: Path) -> None:
    job = submit(queue, tmp_path)
    log = Path(job.model) / "log.txt"
    worker = start_worker(tmp_path)
    try:
        until(lambda: log.is_file() and "slow begins" in log.read_text())
        until(lambda: queue.get(job.id).progress is not None, pause=0.02)
        running = queue.get(job.id)
        assert (running.state, running.outcome) == ("running", None)
        assert worker_is_alive(tmp_path)
    finally:
        end(worker)
    assert not worker_is_alive(tmp_path)
    worker = start_worker(tmp_path)
    try:
        until(lambda: log.read_text().count("slow begins") == 2)
        (Path(job.model) / "go").touch()
        until(lambda: queue.get(job.id).state == "done", pause=0.02)
    finally:
        end(worker)
    done = queue.get(job.id)
    assert done.outcome == "succeeded"
    assert done.progress is not None
    assert done.progress.share == 1.0
    assert log.read_text().splitlines() == [
        "first",
        "slow begins",
        "slow begins",
        "slow ends, first said 42",
        "last",
    ]


def test_cancelling_stops_the_step_and_failures_carry_their_reason(
    queue: JobQueue, tmp_path: Path
) -> None:
    job, after = submit(queue, tmp_path), submit(queue, tmp_path, "fit")
    log = Path(job.model) / "log.txt"
    worker = start_worker(tmp_path)
    try:
        until(lambda: log.is_file() and "slow begins" in log.read_text())
        assert queue.cancel(job.id).outcome == "cancelled"
        until(lambda: queue.get(after.id).state == "done", pause=0.02)
        worker.terminate()
        assert worker.wait(60) == 0
    finally:
        end(worker)
    # The step catches Exception: cancellation must not be one.
    assert log.read_text().splitlines() == ["first", "slow begins"]
    failed = queue.get(after.id)
    assert failed.outcome == "failed"
    assert failed.error is not None
    assert (failed.error.type, failed.error.detail) == ("ValueError", "this capture has no frames")


def test_a_cancelled_step_that_does_not_stop_ends_with_its_process(
    queue: JobQueue, tmp_path: Path
) -> None:
    job = submit(queue, tmp_path)
    Model(job.model).create()
    (Path(job.model) / "deaf").touch()
    log = Path(job.model) / "log.txt"
    worker = start_worker(tmp_path)
    try:
        until(lambda: log.is_file() and "slow begins" in log.read_text())
        queue.cancel(job.id)
        assert worker.stdout is not None
        assert worker.stdout.readline() == "worker-0\n", "the worker is there again, with its name"
        after = submit(queue, tmp_path, "fit")
        until(lambda: queue.get(after.id).state == "done")
        assert worker.poll() is None, "in the same process"
        assert queue.get(job.id).outcome == "cancelled"
        worker.terminate()
        assert worker.wait(60) == 0
    finally:
        end(worker)
    assert log.read_text().splitlines() == ["first", "slow begins"]


def test_progress_is_throttled_but_never_late_at_the_end(tmp_path: Path) -> None:
    now, queries = [0.0], [0]

    def interrupted() -> JobInterrupted | None:
        queries[0] += 1
        return JobCancelled("stop") if now[0] > 100 else None

    progress = StepProgress(
        Model(tmp_path), "job-1", "relight", ("fit", "relight"), interrupted, clock=lambda: now[0]
    )
    progress("early", 0.1)
    now[0] = 0.1
    progress("too soon", 0.2)
    reported = read_progress(Model(tmp_path), "job-1")
    assert reported is not None
    assert (reported.what, reported.step_share, queries[0]) == ("early", 0.1, 1)
    assert reported.share == pytest.approx((63 + 0.1 * 80) / (63 + 80)), "steps take unequal time"
    now[0] = 1.0
    progress("more to do than thought", 0.05)
    reported = read_progress(Model(tmp_path), "job-1")
    assert reported is not None
    assert (reported.what, reported.step_share) == ("more to do than thought", 0.1)
    progress("end", 1.0)
    reported = read_progress(Model(tmp_path), "job-1")
    assert reported is not None
    assert (reported.what, reported.share) == ("end", 1.0)
    assert read_progress(Model(tmp_path), "another job") is None
    now[0] = 101.0
    with pytest.raises(JobCancelled):
        progress("more", 0.3)


def test_workers_of_one_root_have_names_of_their_own(tmp_path: Path) -> None:
    assert not worker_is_alive(tmp_path)
    first, second = WorkerSlot(tmp_path), WorkerSlot(tmp_path)
    assert (first.name, second.name) == ("worker-0", "worker-1")
    first.release()
    third = WorkerSlot(tmp_path)
    assert third.name == "worker-0"
    for slot in (second, third):
        slot.release()


def test_another_user_s_worker_is_found_by_its_heartbeat(tmp_path: Path, monkeypatch) -> None:
    slot = WorkerSlot(tmp_path)
    opened = Path.open

    def refused(path: Path, *how: Any, **more: Any) -> Any:
        if path.name.startswith("worker-"):
            raise PermissionError(13, "Permission denied", str(path))
        return opened(path, *how, **more)

    monkeypatch.setattr(Path, "open", refused)
    assert worker_is_alive(tmp_path)
    os.utime(next(tmp_path.glob("worker-*.lock")), (0, 0))
    assert not worker_is_alive(tmp_path)
    slot.release()

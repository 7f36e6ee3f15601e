"""One job database for two stages, workers that come and go: each job is done once, where it is."""

from __future__ import annotations

import json
import os
import random
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
from postgresql import Missing, PostgreSQL, running
from waiting import until

from reconstruction import Model
from stage_service.jobs import slots
from stage_service.jobs.queue import JobQueue, NoSuchJob, database_url
from stage_service.jobs.records import PipelineRequest
from stage_service.jobs.slots import Namespace, WorkerSlot, hold_dead, worker_statuses

WORKER = Path(__file__).with_name("job_worker.py")


@pytest.fixture(scope="module")
def server() -> Iterator[PostgreSQL]:
    """A PostgreSQL server, started for these tests."""
    try:
        with running() as one:
            yield one
    except Missing as error:
        pytest.skip(str(error))


@pytest.fixture
def postgresql(server: PostgreSQL) -> str:
    """Its URL."""
    return server.url


@pytest.fixture(params=["sqlite", pytest.param("postgresql", marks=pytest.mark.slow)])
def shared(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every root of the test, and every worker, has the same database."""
    url = f"sqlite:///{tmp_path}/shared.sqlite"
    if request.param == "postgresql":
        url = request.getfixturevalue("postgresql")
    monkeypatch.setenv("HAIRSTAGE_DATABASE_URL", url)


def end(worker: subprocess.Popen[str]) -> None:
    worker.kill()
    worker.wait()
    if worker.stdout is not None:
        worker.stdout.close()


class Workers:
    """One light worker for each root, killed and started anew."""

    def __init__(self, *roots: Path) -> None:
        self.killed: set[int] = set()
        self._going = {root: self._start(root) for root in roots}

    def _start(self, root: Path) -> subprocess.Popen[str]:
        command = [sys.executable, str(WORKER), str(root), "light"]
        return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)

    def kill(self, root: Path, *, again: bool = True) -> None:
        worker = self._going.pop(root)
        end(worker)
        self.killed.add(worker.pid)
        if again:
            self._going[root] = self._start(root)

    def check(self) -> None:
        """None has died of itself."""
        assert all(w.poll() is None for w in self._going.values())

    def close(self) -> None:
        for root in list(self._going):
            self.kill(root, again=False)


def two_roots(tmp_path: Path, jobs: int) -> dict[Path, JobQueue]:
    """Both with jobs of the same names."""
    queues = {}
    for name in ("a", "b"):
        root = tmp_path / name
        queues[root] = JobQueue(root)
        for number in range(jobs):
            model = Model(root / "models" / f"m{number}")
            request = PipelineRequest(name="fit")
            queues[root].submit(request, root / "captures" / "c", model, job=f"job-{number}")
    return queues


def check_done_once(root: Path, queue: JobQueue, killed: set[int]) -> int:
    """Every job succeeded, by workers of its own root, no two of them on one step side by side;
    how many steps were done again because their worker was killed."""
    again = 0
    for job in queue.all(limit=1000):
        assert (job.outcome, job.error) == ("succeeded", None), job
        lines = [line.split(" ", 2) for line in _lines(job.model)]
        begun = 0
        for what, pid, of in (line for line in lines if len(line) == 3):
            assert of.strip() == str(root), "a job of another stage"
            if what == "begins":
                begun += 1
                holder = pid
            else:
                assert pid == holder, "two workers at once"
        # Three steps once each, and more only where the worker was killed meanwhile.
        assert begun >= 3
        again += begun - 3
    assert again <= len(killed)
    return again


def _lines(model: str) -> list[str]:
    return (Path(model) / "log.txt").read_text().splitlines()


def done(queue: JobQueue, workers: Workers) -> int:
    workers.check()
    return sum(j.state == "done" for j in queue.all(limit=1000))


def _so_many(queue: JobQueue, workers: Workers, least: int) -> bool:
    return done(queue, workers) >= least


@pytest.mark.parametrize(
    ("jobs", "kills"), [(3, 1), pytest.param(100, 12, marks=pytest.mark.slow)], ids=["6", "200"]
)
def test_two_stages_in_one_database_do_their_own_jobs_once(shared, tmp_path, jobs, kills):
    queues = two_roots(tmp_path, jobs)
    a, b = queues
    assert [j.id for j in queues[a].all(limit=1000)] == [j.id for j in queues[b].all(limit=1000)]
    pick = random.Random(0)
    workers = Workers(a, b)
    try:
        for kill in range(kills):
            root, share = pick.choice((a, b)), (kill + 1) * jobs // (kills + 1)
            until(partial(_so_many, queues[root], workers, share), pause=0.05)
            workers.kill(root)
        until(lambda: sum(done(q, workers) for q in queues.values()) == 2 * jobs, pause=0.1)
        for root, queue in queues.items():
            assert len(queue.ids()) == jobs
            check_done_once(root, queue, workers.killed)
    finally:
        workers.close()
        for queue in queues.values():
            queue.close()


def test_a_dead_workers_job_is_taken_up_by_another_of_its_machine(tmp_path):
    queue = JobQueue(tmp_path)
    job = queue.submit(
        PipelineRequest(name="reconstruct"), tmp_path, Model(tmp_path / "m"), job="j"
    )
    log = Path(job.model) / "log.txt"
    command = [sys.executable, str(WORKER), str(tmp_path)]
    first = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    second = None
    try:
        until(lambda: log.exists() and "slow begins" in log.read_text())
        second = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert second.stdout.readline() == "worker-1\n"
        assert [w.alive for w in worker_statuses(tmp_path)] == [True, True]
        end(first)
        until(lambda: log.read_text().count("slow begins") == 2)
        (Path(job.model) / "go").touch()
        until(lambda: queue.get("j").outcome == "succeeded", pause=0.02)
        assert [w.alive for w in worker_statuses(tmp_path)] == [False, True]
    finally:
        for worker in filter(None, (first, second)):
            end(worker)
        queue.close()


def test_priorities_retries_and_time_outs(tmp_path):
    queue = JobQueue(tmp_path)

    def submit(job: str, pipeline: str, **more: float) -> Path:
        request = PipelineRequest(name=pipeline, **more)
        model = Model(tmp_path / "models" / job).create()
        queue.submit(request, tmp_path / "c", model, job=job)
        return model.path

    submit("late", "reconstruct", timeout_s=1.0, priority=9)
    (submit("tried-twice", "fit", retries=1, priority=3) / "fails").write_text("1")
    submit("urgent", "fit", priority=0)
    worker = subprocess.Popen([sys.executable, str(WORKER), str(tmp_path)])
    try:
        until(lambda: queue.get("late").state == "done", pause=0.02)
        late, urgent, tried = (queue.get(j) for j in ("late", "urgent", "tried-twice"))
        assert (late.outcome, late.error.type) == ("failed", "JobTimeout")
        assert "1 s" in late.error.detail
        assert urgent.outcome == "failed"
        assert tried.outcome == "succeeded"
        order = (tmp_path / "models" / "order.txt").read_text().split()
        assert order == ["urgent", "tried-twice", "tried-twice"]
    finally:
        end(worker)
        queue.close()


@pytest.mark.slow
def test_rendering_steps_wait_for_a_gpu_if_the_service_requires_it(tmp_path):
    queue = JobQueue(tmp_path, gpu_workers=True)
    for name in ("fit", "reconstruct"):
        queue.submit(PipelineRequest(name=name), tmp_path, Model(tmp_path / name), job=name)
    (Model(tmp_path / "reconstruct").create().path / "go").touch()
    worker = subprocess.Popen([sys.executable, str(WORKER), str(tmp_path)])
    try:
        until(lambda: queue.get("reconstruct").state == "done", pause=0.02)
        assert queue.get("fit").state == "queued"
        gpu = subprocess.Popen([sys.executable, str(WORKER), str(tmp_path), "gpu"])
        try:
            until(lambda: queue.get("fit").state == "done", pause=0.02)
        finally:
            end(gpu)
    finally:
        end(worker)
        queue.close()


def test_names_are_the_roots_own_wherever_it_is_mounted(tmp_path):
    root, other = tmp_path / "root", tmp_path / "other"
    for folder in (root, other):
        folder.mkdir()
    moved = tmp_path / "elsewhere"
    names = Namespace(root)
    root.rename(moved)
    assert Namespace(moved).application == names.application != Namespace(other).application
    assert names.job(names.workflow("job-1")) == "job-1"
    queue = JobQueue(moved)
    queue.submit(PipelineRequest(name="fit"), moved / "c", Model(moved / "models/m"), job="j")
    queue.close()
    moved.rename(root)
    queue = JobQueue(root)
    assert (queue.get("j").model, queue.get("j").capture) == (f"{root}/models/m", f"{root}/c")
    with pytest.raises(NoSuchJob):
        queue.get(names.workflow("j"))
    queue.close()
    (root / "jobs.id").write_text("../x")
    with pytest.raises(ValueError, match="12 hexadecimal digits"):
        Namespace(root)


def test_the_worker_of_another_machine_is_not_dead_because_its_lock_is_free(tmp_path, monkeypatch):
    here = WorkerSlot(tmp_path)
    executor = Namespace(tmp_path).executor(here)
    assert hold_dead(tmp_path, executor) is None
    monkeypatch.setattr(slots, "HOST", "another")
    here.release()
    assert hold_dead(tmp_path, executor) is None
    (observed,) = worker_statuses(tmp_path)
    assert (observed.name, observed.alive) == (
        "worker-0",
        True,
    )  # until it has been silent for long
    os.utime(next(tmp_path.glob("worker-*.lock")), (0, 0))
    assert not worker_statuses(tmp_path)[0].alive


def test_a_server_is_given_limits_that_its_url_does_not_set(tmp_path, monkeypatch):
    monkeypatch.setenv("HAIRSTAGE_DATABASE_URL", "postgresql://h/d?connect_timeout=3")
    url = database_url(tmp_path, 8)
    assert "connect_timeout=3&" in url
    assert "statement_timeout%3D8000" in url
    assert "statement_timeout" not in database_url(tmp_path)


def test_a_statement_that_never_ends_does_not_hold_the_service(postgresql, tmp_path, monkeypatch):
    import psycopg

    from stage_service.jobs import queue as queues
    from stage_service.jobs.queue import JobsUnavailable

    monkeypatch.setenv("HAIRSTAGE_DATABASE_URL", postgresql)
    monkeypatch.setattr(queues, "STATEMENT_S", 0.5)
    queue = JobQueue(tmp_path)
    assert queue.all() == []
    with psycopg.connect(postgresql) as other:
        other.execute("LOCK TABLE dbos.workflow_status IN ACCESS EXCLUSIVE MODE")
        with pytest.raises(JobsUnavailable, match=r"a request took longer than 0\.5 s"):
            queue.all()
    assert queue.all() == []
    queue.close()


def test_a_server_that_goes_and_comes_back_is_a_line_each_in_a_worker_s_log(
    server, tmp_path, monkeypatch
):
    """F15: of DBOS's threads alone each would log several failures a second, with tracebacks."""
    monkeypatch.setenv("HAIRSTAGE_DATABASE_URL", server.url)
    log = tmp_path / "log"
    command = [sys.executable, "-m", "stage_service.cli", "worker", "--json", "--log-json"]
    with log.open("w") as stderr:
        worker = subprocess.Popen(
            [*command, "--root", tmp_path / "root"],
            stdout=subprocess.PIPE,
            stderr=stderr,
            text=True,
        )
    try:
        assert "worker-0" in worker.stdout.readline()
        server.stop()
        try:
            until(lambda: "the job database: " in log.read_text())
        finally:
            server.start()
        until(lambda: "the job database: over after" in log.read_text())
        # What it cannot do without: the jobs go on by themselves.
        queue = JobQueue(tmp_path / "root")
        queue.submit(PipelineRequest(name="reconstruct"), tmp_path, Model(tmp_path / "m"), job="j")
        until(lambda: queue.get("j").state == "done", pause=0.1)
        queue.close()
    finally:
        end(worker)
    lines = [json.loads(line) for line in log.read_text().splitlines()]  # none of another format
    of_it = [line["message"] for line in lines if line["message"].startswith("the job database")]
    assert len(of_it) == 2, of_it
    times = re.fullmatch(r"the job database: over after \d+ s \(it came (\d+) times\)", of_it[1])
    assert times is not None
    assert int(times[1]) >= 1
    logged = [(line["logger"], line["level"]) for line in lines if "j: " not in line["message"]]
    assert logged == [("hairstage.jobs", "ERROR"), ("hairstage.jobs", "WARNING")]

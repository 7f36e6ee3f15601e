"""The job database that is broken, gone, or hangs: the jobs suffer, nothing else does."""

from __future__ import annotations

import os
import shutil
import socket
import sqlite3
import threading
from pathlib import Path

import pytest
from waiting import until

from reconstruction import Model
from stage_service.acquisition.states import CaptureStatus
from stage_service.jobs import queue as queues
from stage_service.jobs.follower import JobFollower, job_of
from stage_service.jobs.progress import read_progress
from stage_service.jobs.queue import JobQueue, JobsUnavailable
from stage_service.jobs.records import Job, PipelineRequest
from stage_service.records.audit import AuditLog
from stage_service.records.events import EventLog


def submit(queue: JobQueue, root: Path, job: str, model: str = "m") -> Job:
    request = PipelineRequest(name="reconstruct")
    return queue.submit(request, root / "capture", Model(root / "models" / model), job=job)


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A database with three jobs."""
    root = tmp_path_factory.mktemp("sound")
    queue = JobQueue(root)
    for number in range(3):
        submit(queue, root, f"job-{number}", f"m{number}")
    queue.close()
    with sqlite3.connect(root / "jobs.sqlite") as database:
        database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    database.close()
    return root / "jobs.sqlite"


@pytest.mark.parametrize("damage", ["random", "half", "a page of zeros", "another program's"])
def test_a_broken_database_is_set_aside_and_said(damage, sound, tmp_path):
    file = tmp_path / "jobs.sqlite"
    whole = sound.read_bytes()
    if damage == "another program's":
        with sqlite3.connect(file) as database:
            database.execute("CREATE TABLE recipes (name TEXT)")
        database.close()
    else:
        file.write_bytes(
            {
                "random": os.urandom(8192),
                "half": whole[: len(whole) // 2],
                "a page of zeros": whole[:4096] + bytes(4096) + whole[8192:],
            }[damage]
        )
    broken = file.read_bytes()
    queue = JobQueue(tmp_path)
    assert queue.all() == []
    assert submit(queue, tmp_path, "job-new").state == "queued"
    (aside,) = tmp_path.glob("jobs.sqlite.broken-*")
    assert aside.read_bytes() == broken
    assert aside.name in queue.set_aside
    queue.close()
    again = JobQueue(tmp_path)
    assert [j.id for j in again.all()] == ["job-new"]
    assert again.set_aside is None
    again.close()


@pytest.mark.parametrize("sizes", ["whole", "empty"])
def test_a_sound_or_empty_database_stays_where_it_is(sizes, sound, tmp_path):
    for name in ("jobs.sqlite", "jobs.id"):
        shutil.copy(sound.with_name(name), tmp_path / name)
    if sizes == "empty":
        (tmp_path / "jobs.sqlite").write_bytes(b"")
    queue = JobQueue(tmp_path)
    assert len(queue.all()) == (3 if sizes == "whole" else 0)
    assert queue.set_aside is None
    queue.close()


def test_jobs_are_listed_page_by_page(sound, tmp_path):
    for name in ("jobs.sqlite", "jobs.id"):
        shutil.copy(sound.with_name(name), tmp_path / name)
    queue = JobQueue(tmp_path)
    pages = [[j.id for j in queue.all(limit=2, offset=o)] for o in (0, 2, 4)]
    assert sorted(job for page in pages for job in page) == ["job-0", "job-1", "job-2"]
    assert [len(p) for p in pages] == [2, 1, 0]
    assert queue.ids() == {"job-0", "job-1", "job-2"}
    model = Model(tmp_path / "models" / "mine")
    assert queue.at_work_on(model) is None
    submit(queue, tmp_path, "job-mine", "mine")
    assert queue.at_work_on(model) == "job-mine"
    queue.cancel("job-mine")
    assert queue.at_work_on(model) is None
    queue.close()


@pytest.mark.parametrize("text", ["", "[]", "{}", "[" * 10**5, '{"job": "job-1", "share": NaN}'])
def test_progress_that_cannot_be_read_is_no_progress(text, tmp_path):
    (tmp_path / "progress.json").write_text(text)
    assert read_progress(Model(tmp_path), "job-1") is None


WHY = {"down": "Connection refused", "deaf": "connection timeout expired"}
MEANWHILE = "Captures and blackout work meanwhile; jobs resume by themselves once it is back."


def test_a_database_that_is_down_or_silent_is_reported_in_a_sentence(monkeypatch, tmp_path):
    monkeypatch.setattr(queues, "CONNECT_S", 2)  # the least that libpq takes
    with socket.create_server(("127.0.0.1", 0)) as deaf:
        ports = {"down": 1, "deaf": deaf.getsockname()[1]}
        for which, port in ports.items():
            url = f"postgresql://nobody:secret@127.0.0.1:{port}/nothing"
            monkeypatch.setenv("HAIRSTAGE_DATABASE_URL", url)
            queue = JobQueue(tmp_path)
            with pytest.raises(JobsUnavailable) as refusal:
                queue.all()
            place = f"The job database at 127.0.0.1:{port} does not respond"
            assert str(refusal.value) == queue.problem == f"{place}: {WHY[which]}. {MEANWHILE}"
            queue.close()


def test_an_unusable_database_file_is_reported_in_a_sentence(monkeypatch, tmp_path):
    (tmp_path / "folder").mkdir()
    monkeypatch.setenv("HAIRSTAGE_DATABASE_URL", f"sqlite:////{tmp_path}/folder")
    queue = JobQueue(tmp_path)
    with pytest.raises(
        JobsUnavailable, match=r"^The job database /\S*folder cannot be used: [^(]*$"
    ):
        queue.all()


def test_a_silent_database_gets_no_more_requests_until_it_responds(monkeypatch, tmp_path):
    """Each would keep a thread for as long as that lasts."""
    queue, calls, release = JobQueue(tmp_path), [], threading.Event()
    assert queue.all() == []
    client = queue._client

    class Silent:
        def list_workflows(self, **_: object) -> list[object]:
            calls.append(1)
            release.wait()
            return []

    queue._client = Silent()
    monkeypatch.setattr(queues, "NO_REPLY_S", 0.1)
    thread = threading.Thread(target=queue.all)
    thread.start()
    until(lambda: queue.problem is not None)
    for _ in range(3):
        with pytest.raises(
            JobsUnavailable, match="cannot be used: a request has had no response for"
        ):
            queue.all()
    assert calls == [1]
    release.set()
    thread.join(60)
    assert queue.problem is None
    queue._client = client
    assert queue.all() == []
    queue.close()


def completed(root: Path, name: str) -> CaptureStatus:
    zeros = dict.fromkeys(("steps", "step", "frames_planned", "frames_written"), 0)
    return CaptureStatus(
        id=name,
        state="done",
        outcome="completed",
        error=None,
        path=str(root / "captures" / name),
        **zeros,
        frames_missing=0,
        seconds_predicted=None,
        seconds=None,
        left_out=[],
        started=None,
        request={"pipeline": {"name": "reconstruct"}},
    )


def test_pending_jobs_are_enqueued_once_the_database_is_back(monkeypatch, tmp_path):
    monkeypatch.setenv("HAIRSTAGE_DATABASE_URL", "postgresql://nobody@127.0.0.1:1/nothing")
    queue = JobQueue(tmp_path)
    follower = JobFollower(tmp_path, queue, EventLog(), AuditLog(tmp_path / "audit.jsonl"))
    follower.follow_up(completed(tmp_path, "fresh"))
    follower.follow_up(completed(tmp_path, "lost"), fresh=False)
    follower.follow_up(completed(tmp_path, "made"), fresh=False)
    Model(tmp_path / "models" / "made").create()
    follower.start()
    try:
        until(lambda: queue.problem is not None)
        assert follower.job_after("fresh") == job_of("fresh")
        monkeypatch.delenv("HAIRSTAGE_DATABASE_URL")
        until(lambda: queue.problem is None and follower.job_after("made") is None)
        # A model that is there is not made again because its job was lost with the database.
        assert queue.ids() == {job_of("fresh"), job_of("lost")}
        entries = AuditLog(tmp_path / "audit.jsonl").latest(10)
        assert sorted((a.who, a.action, a.subject) for a in entries) == [
            ("service", "job.submit", job_of("fresh")),
            ("service", "job.submit", job_of("lost")),
        ]
    finally:
        follower.close()
        queue.close()


def test_the_audit_has_the_end_of_every_job_once(tmp_path):
    """Of those too that ended while no service ran, and of older ones than the newest fifty."""
    queue, audit = JobQueue(tmp_path), AuditLog(tmp_path / "audit.jsonl")
    for number in range(60):
        submit(queue, tmp_path, f"job-{number:02d}", f"m{number}")
    queue.cancel("job-00")

    def ends() -> list[str]:
        return [f"{a.subject} {a.result}" for a in audit.latest(100) if a.action == "job.end"]

    for before, job in enumerate(("job-01", "job-59"), 1):
        follower = JobFollower(tmp_path, queue, EventLog(), audit)
        follower.start()
        until(lambda n=before: len(ends()) == n)
        queue.cancel(job)
        until(lambda n=before: len(ends()) == n + 1)
        follower.close()
    assert ends() == ["job-00 cancelled", "job-01 cancelled", "job-59 cancelled"]
    assert audit.latest(1)[0].detail.startswith("reconstruct on capture, at 20")
    queue.close()


def test_a_new_job_is_followed_after_the_clock_was_set_back(tmp_path):
    """Jobs are listed by the clock: fifty that were made before are newer by it."""
    queue, audit = JobQueue(tmp_path), AuditLog(tmp_path / "audit.jsonl")
    for number in range(51):
        submit(queue, tmp_path, f"job-{number}", f"m{number}")
    with sqlite3.connect(tmp_path / "jobs.sqlite") as database:
        database.execute("UPDATE workflow_status SET created_at = created_at + 30 * 86400000")
    database.close()
    follower = JobFollower(tmp_path, queue, EventLog(), audit)
    follower.start()
    try:
        until(lambda: follower.waiting is not None)  # it has listed the jobs
        follower.follow_up(completed(tmp_path, "late"))
        until(lambda: job_of("late") in queue.ids())
        assert job_of("late") not in {job.id for job in queue.all(limit=50)}
        queue.cancel(job_of("late"))
        until(lambda: [a.subject for a in audit.latest(10)][-1:] == [job_of("late")])
        until(lambda: audit.latest(1)[0].action == "job.end")
    finally:
        follower.close()
        queue.close()

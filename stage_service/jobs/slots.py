"""Names of a root folder and its workers in a job database that other roots may share."""

from __future__ import annotations

import fcntl
import os
import re
import secrets
import socket
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from reconstruction.files.durable import write_whole
from reconstruction.reading import printable

HOST = re.sub(r"[^A-Za-z0-9-]", "-", socket.gethostname())[:60] or "host"
BEAT_S = 1.0
"""Interval of a worker's heartbeat."""
SILENT_S = 30.0
"""A worker of another machine without a heartbeat for this long counts as gone."""


class Namespace:
    """Unique names for one root folder, from its `jobs.id`, on every machine that mounts it."""

    def __init__(self, root: Path) -> None:
        file = root / "jobs.id"
        with (root / "jobs.lock").open("a") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not file.exists():
                write_whole(file, f"{secrets.token_hex(6)}\n".encode())
        self._id = printable(file.read_text(errors="replace").strip())
        if re.fullmatch("[0-9a-f]{12}", self._id) is None:
            raise ValueError(f"{file}: expected 12 hexadecimal digits, got {self._id[:40]!r}")
        self.application = f"hairstage-{self._id}"

    def version(self, steps: str) -> str:
        """The database's name of a version of the pipelines' steps."""
        return f"{self.application}-{steps}"

    def queue(self, gpu: bool) -> str:
        """The queue of the workers with, or without, a GPU."""
        return f"{self.application}-{'gpu' if gpu else 'jobs'}"

    def workflow(self, job: str) -> str:
        """A job's id in the database."""
        return f"{self._id}:{job}"

    def job(self, workflow: str) -> str:
        """The job's own id."""
        return workflow.removeprefix(f"{self._id}:")

    def executor(self, worker: WorkerSlot) -> str:
        """A worker's unique name in the database."""
        return f"{self._id}/{worker.host}/{worker.name}"


class WorkerSlot:
    """A worker's name, unique among one root's on one machine: the first with a free lock file.

    The kernel frees the lock when the process dies. The next worker takes the dead one's name, and
    with it its jobs.
    """

    host = HOST

    def __init__(self, root: Path) -> None:
        number = 0
        while (file := _hold(_file(root, HOST, f"worker-{number}"))) is None:
            number += 1
        self._file = file
        self.name = f"worker-{number}"
        self.beat()

    def beat(self) -> None:
        """Update the heartbeat."""
        os.utime(self._file.fileno())

    def release(self) -> None:
        """Release the name before the process ends."""
        self._file.close()


@dataclass(frozen=True)
class WorkerStatus:
    """A worker of this root; `age_s`: seconds since its last heartbeat."""

    host: str
    name: str
    alive: bool
    age_s: float


def worker_statuses(root: Path) -> list[WorkerStatus]:
    """Every worker that this root has had, on any machine."""
    found = []
    for path in sorted(root.glob("worker-*.lock")):
        name, _, host = path.stem.partition("@")
        age = max(0.0, time.time() - path.stat().st_mtime)
        alive = age < SILENT_S
        if host == HOST:
            with suppress(PermissionError):  # another user's: by its heartbeat
                # A shared lock, so that several processes may check at once.
                file = _hold(path, fcntl.LOCK_SH)
                alive = file is None
                if file is not None:
                    file.close()
        found.append(WorkerStatus(host, name, alive, age))
    return found


def hold_dead(root: Path, executor: str) -> IO[str] | None:
    """Lock the name of a dead worker of this machine, by its name in the database; None where it
    lives or is of another machine. Closing the file releases the name."""
    _, host, name = executor.split("/") if executor.count("/") == 2 else ("", "", "")
    return _hold(_file(root, host, name)) if host == HOST else None


def _file(root: Path, host: str, name: str) -> Path:
    return root / f"{name}@{host}.lock"


def _hold(path: Path, how: int = fcntl.LOCK_EX) -> IO[str] | None:
    file = path.open("a")
    try:
        fcntl.flock(file, how | fcntl.LOCK_NB)
    except BlockingIOError:
        file.close()
        return None
    return file

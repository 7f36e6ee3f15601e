"""What a studio's monitoring asks for: figures of the service, and whether it can shoot."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from reconstruction.files.durable import RESERVE
from stage_service.captures.manager import CaptureManager
from stage_service.devices.cached_status import CachedStatus
from stage_service.jobs.follower import JobFollower
from stage_service.jobs.queue import JobQueue
from stage_service.jobs.slots import worker_statuses

LONGEST_LOOK_S = 0.5
"""How long a request waits for a disk that is slow to say how it is."""

SILENT_S = 5.0
"""How long a disk may take to say how it is."""


@dataclass(frozen=True)
class Metric:
    """A figure of one name: `samples` has its value for each set of labels.

    A "counter" counts since the service started.
    """

    name: str
    help: str
    samples: list[tuple[dict[str, str], float]]
    kind: str = "gauge"


class NotReady(RuntimeError):
    """A capture could not begin now; `problems` says why."""

    def __init__(self, problems: list[str]) -> None:
        super().__init__("; ".join(problems))
        self.problems = problems


class Watching:
    """Figures of one service. Nobody who asks touches a device or the job database: those are as
    they were when they were last seen, and how long ago that was is a figure, too."""

    def __init__(
        self, root: Path, captures: CaptureManager, queue: JobQueue, follower: JobFollower
    ) -> None:
        self.root, self.captures, self.queue, self.follower = root, captures, queue, follower
        self._started = time.time()
        unseen: dict[str, Any] = {"free": None, "workers": [], "gone": None}
        self._disk = CachedStatus(self._look, unseen, LONGEST_LOOK_S)

    def disk(self) -> tuple[int | None, bool]:
        """What the disk of the root folder has left, None where it does not answer; and whether it
        has said that a worker runs."""
        seen = self._disk.get()
        worker = any(w.alive for w in seen["workers"])
        if seen["free"] is None or self._disk.running_s() > SILENT_S:
            return None, worker
        return int(seen["free"]), worker

    def problems(self) -> list[str]:
        """Why no capture could begin, a sentence each; one that runs is no reason."""
        not_dark, disk = self.captures.not_dark(), self._disk.get()
        found = [] if not_dark is None else [not_dark]
        free = disk["free"]
        if disk["gone"]:
            found.append(disk["gone"])
        elif free is None or self._disk.running_s() > SILENT_S:
            found.append(f"{self.root}: the disk does not answer")
        elif free < RESERVE:
            left = f"{free / 1e6:.0f} MB free; {RESERVE / 1e6:.0f} MB are kept"
            found.append(f"{self.root}: {left}")
        return found

    def metrics(self) -> Iterator[Metric]:
        """Every figure."""
        captures, disk, jobs = self.captures, self._disk.get(), self.follower.waiting
        safety, running = captures.safety(), captures.running_state
        yield _one("start_time_seconds", "when the service started", self._started)
        latched = "1 while a blackout has failed and nothing may be lit"
        yield _one("latched", latched, _latched(safety))
        yield _per("lamps", "1 for what is known of the lamps", "state", {safety["state"]: 1.0})
        yield _per("capture", "1 for the state that the capture is in", "state", {running: 1.0})
        yield _one("captures_unread", "on the disk and not listed yet", captures.catalogue.unread)
        counts = captures.counts()
        for name, (label, text) in _COUNTED.items():
            yield _per(f"{name}_total", text, label, counts[name], "counter")
        reachable = {
            name: float(state == "ok")
            for name, state in captures.stage.states().items()
            if state in ("ok", "unreachable")
        }
        yield _per("device_reachable", "when it was last asked", "device", reachable)
        if disk["free"] is not None:
            yield _one("disk_free_bytes", "of the root folder", disk["free"])
            yield _one("disk_seen_age_seconds", "since the disk was last seen", disk["age_s"])
        yield _one("job_database_up", "1 while it answers", float(self.queue.problem is None))
        if jobs is not None:
            states = {"queued": float(jobs.queued), "running": float(jobs.running)}
            yield _per("jobs", "not done", "state", states)
            yield _one("job_wait_seconds", "of the job that has waited longest", jobs.oldest_s)
            age = time.monotonic() - self.follower.waiting_at
            yield _one("jobs_seen_age_seconds", "since the job database was last seen", age)
        alive = {f"{w.host}/{w.name}": float(w.alive) for w in disk["workers"]}
        ages = {f"{w.host}/{w.name}": w.age_s for w in disk["workers"]}
        yield _per("worker_alive", "1 while it lives", "worker", alive)
        yield _per("worker_heartbeat_age_seconds", "since it last said so", "worker", ages)

    def _look(self) -> dict[str, Any]:
        try:
            free = float(shutil.disk_usage(self.captures.folder).free)
        except OSError as error:
            gone = f"{self.captures.folder}: {error.strerror}: is its disk there?"
            return {"free": None, "workers": [], "gone": gone}
        return {"free": free, "workers": worker_statuses(self.root), "gone": None}


_COUNTED = {
    "captures": ("outcome", "that ended"),
    "frames": ("what", "written, missing after all retries, and shot again"),
    "device_faults": ("device", "that ended a capture"),
}
"""What `CaptureManager.counts` has: the label of each, and its help."""


def text_of(metrics: Iterator[Metric]) -> str:
    """The figures in Prometheus's text format, version 0.0.4."""
    lines = []
    for metric in metrics:
        name = f"hairstage_{metric.name}"
        lines += [f"# HELP {name} {metric.help}", f"# TYPE {name} {metric.kind}"]
        for labels, value in metric.samples:
            told = ",".join(f'{k}="{_escaped(v)}"' for k, v in labels.items())
            lines.append(f"{name}{{{told}}} {value!r}" if told else f"{name} {value!r}")
    return "\n".join(lines) + "\n"


def _escaped(text: str) -> str:
    return text.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")


def _latched(safety: dict[str, Any]) -> float:
    return float(safety["latched"] is not None)


def _one(name: str, help: str, value: float) -> Metric:
    return Metric(name, help, [({}, float(value))])


def _per(
    name: str, help: str, label: str, values: Mapping[str, float], kind: str = "gauge"
) -> Metric:
    samples = [({label: key}, float(value)) for key, value in values.items()]
    return Metric(name, help, samples, kind)

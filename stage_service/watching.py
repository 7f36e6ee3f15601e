"""Monitoring: health, readiness and Prometheus metrics of the service."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from reconstruction.files.durable import RESERVE
from stage_service.captures.manager import CaptureManager
from stage_service.devices.cached_status import CachedStatus
from stage_service.jobs.follower import JobFollower
from stage_service.jobs.queue import JobQueue
from stage_service.jobs.slots import worker_statuses
from stage_service.service_models import Health, LatchView

DISK_WAIT_S = 0.5
"""Seconds that a request waits for the disk."""

SILENT_S = 5.0
"""Seconds after which a disk counts as hanging."""


@dataclass(frozen=True)
class Metric:
    """A Prometheus metric: `samples` has its value for each set of labels. A "counter" counts since
    the service started."""

    name: str
    help: str
    samples: list[tuple[dict[str, str], float]]
    kind: str = "gauge"


class NotReady(RuntimeError):
    """No capture could start now; `problems` has the reasons."""

    def __init__(self, problems: list[str]) -> None:
        super().__init__("; ".join(problems))
        self.problems = problems


class Watching:
    """Figures of one service, from the newest status of devices, disk and job database, whose age
    is a figure, too; nothing is queried."""

    def __init__(
        self, root: Path, captures: CaptureManager, queue: JobQueue, follower: JobFollower
    ) -> None:
        self.root, self.captures, self.queue, self.follower = root, captures, queue, follower
        self._started = time.time()
        initial: dict[str, Any] = {"free": None, "workers": [], "gone": None}
        self._disk = CachedStatus(self._query_disk, initial, DISK_WAIT_S)

    def disk(self) -> tuple[int | None, bool]:
        """Free bytes on the root folder's disk, None if it hangs, and whether a worker is alive."""
        status = self._disk.get()
        worker = any(w.alive for w in status["workers"])
        if status["free"] is None or self._disk.running_s() > SILENT_S:
            return None, worker
        return int(status["free"]), worker

    def problems(self) -> list[str]:
        """Why no capture could start, a sentence each; a running one is no reason."""
        not_dark, disk = self.captures.not_dark(), self._disk.get()
        found = [] if not_dark is None else [not_dark]
        free = disk["free"]
        if disk["gone"]:
            found.append(disk["gone"])
        elif free is None or self._disk.running_s() > SILENT_S:
            found.append(f"{self.root}: the disk does not respond")
        elif free < RESERVE:
            left = f"{free / 1e6:.0f} MB free; {RESERVE / 1e6:.0f} MB are kept"
            found.append(f"{self.root}: {left}")
        return found

    def health(self, *, stopping: bool) -> Health:
        """The service's health."""
        free_bytes, worker = self.disk()
        lamps, latched = self.captures.safety(), self.captures.stage.latch.latched
        problems = [p for p in (self.queue.set_aside, self.queue.problem) if p is not None]
        if stopping:
            problems.insert(0, "the service is stopping and lights nothing")
        if latched is not None:
            problems.insert(0, latched.detail)
        return Health(
            status="unsafe" if latched else "degraded" if problems else "ok",
            version=version("hairstage"),
            rig=self.captures.rig_file.rig.name,
            root=str(self.root),
            worker=worker,
            capture=self.captures.running,
            unread=self.captures.unlisted,
            lamps=lamps["state"],
            lamps_detail=lamps["detail"],
            lamps_accepted=lamps["accepted"],
            latch=LatchView.of(latched),
            disk_free_bytes=free_bytes,
            problems=problems,
        )

    def metrics(self) -> Iterator[Metric]:
        """Every metric."""
        captures, disk, jobs = self.captures, self._disk.get(), self.follower.waiting
        safety, running = captures.safety(), captures.running_state
        yield _one("start_time_seconds", "when the service started", self._started)
        latched = "1 after a failed blackout: nothing may be lit"
        yield _one("latched", latched, _latched(safety))
        yield _per("lamps", "1 for the lamps' state", "state", {safety["state"]: 1.0})
        yield _per("capture", "1 for the capture's state", "state", {running: 1.0})
        yield _one("captures_unread", "captures not listed yet", captures.unlisted)
        counts = captures.counts()
        for name, (label, text) in _COUNTED.items():
            yield _per(f"{name}_total", text, label, counts[name], "counter")
        reachable = {
            name: float(state == "ok")
            for name, state in captures.stage.states().items()
            if state in ("ok", "unreachable")
        }
        yield _per("device_reachable", "1 if it replied last", "device", reachable)
        if disk["free"] is not None:
            yield _one("disk_free_bytes", "free on the root folder's disk", disk["free"])
            yield _one("disk_seen_age_seconds", "age of that figure", disk["age_s"])
        yield _one("job_database_up", "1 while it responds", float(self.queue.problem is None))
        if jobs is not None:
            states = {"queued": float(jobs.queued), "running": float(jobs.running)}
            yield _per("jobs", "queued and running", "state", states)
            yield _one("job_wait_seconds", "wait of the oldest queued job", jobs.oldest_s)
            age = time.monotonic() - self.follower.waiting_at
            yield _one("jobs_seen_age_seconds", "age of the jobs' figures", age)
        alive = {f"{w.host}/{w.name}": float(w.alive) for w in disk["workers"]}
        ages = {f"{w.host}/{w.name}": w.age_s for w in disk["workers"]}
        yield _per("worker_alive", "1 while it is alive", "worker", alive)
        yield _per(
            "worker_heartbeat_age_seconds",
            "since its last heartbeat",
            "worker",
            ages,
        )

    def _query_disk(self) -> dict[str, Any]:
        try:
            free = float(shutil.disk_usage(self.captures.folder).free)
        except OSError as error:
            gone = f"{self.captures.folder}: {error.strerror}: check its disk"
            return {"free": None, "workers": [], "gone": gone}
        return {"free": free, "workers": worker_statuses(self.root), "gone": None}


_COUNTED = {
    "captures": ("outcome", "captures that ended"),
    "frames": ("what", "frames written, missing after all retries, and shot again"),
    "device_faults": ("device", "faults that ended a capture"),
}
"""The counters of `CaptureManager.counts`: label and help of each."""


def text_of(metrics: Iterator[Metric]) -> str:
    """The metrics in Prometheus's text format, version 0.0.4."""
    lines = []
    for metric in metrics:
        name = f"hairstage_{metric.name}"
        lines += [f"# HELP {name} {metric.help}", f"# TYPE {name} {metric.kind}"]
        for labels, value in metric.samples:
            text = ",".join(f'{k}="{_escaped(v)}"' for k, v in labels.items())
            lines.append(f"{name}{{{text}}} {value!r}" if text else f"{name} {value!r}")
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

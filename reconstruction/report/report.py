"""The report of a pipeline: per stage seconds, figures, error against run time, warnings."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from reconstruction.files.durable import write_json
from reconstruction.options import sentence

Progress = Callable[[str, float], None]
"""Called with the current activity and the share done, 0 to 1."""


def silent(_what: str, _share: float) -> None:
    """A `Progress` that does nothing."""


_RESET, _STATUS = Path("/proc/self/clear_refs"), Path("/proc/self/status")


@dataclass(eq=False)
class Peak:
    """`gb`: peak resident memory of the process, GB; None if unknown."""

    gb: float | None = None


_open: list[Peak] = []


@contextmanager
def peak_memory() -> Iterator[Peak]:
    """Measure the block; blocks may be nested, but not run on several threads."""
    _note()  # earlier memory counts for the enclosing blocks
    peak = Peak()
    _open.append(peak)
    with suppress(OSError):
        _RESET.write_text("5")
    try:
        yield peak
    finally:
        _note()
        _open.remove(peak)


def usable_cores() -> int:
    """Processor cores that this process may use; all of them where the system does not say."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def free_memory() -> float | None:
    """Available memory, GB; None if unknown."""
    return _gb(Path("/proc/meminfo"), "MemAvailable")


def resident_memory() -> float | None:
    """Resident memory of this process, GB; None if unknown."""
    return _gb(_STATUS, "VmRSS")


def _note() -> None:
    now = _gb(_STATUS, "VmHWM") if _open else None
    if now is not None:
        for peak in _open:
            peak.gb = max(peak.gb or 0.0, now)


def _gb(path: Path, name: str) -> float | None:
    with suppress(OSError):
        for line in path.read_text().splitlines():
            if line.startswith(name):
                return int(line.split()[1]) * 1024 / 1e9
    return None


@dataclass
class Series:
    """Error against run time: `points` are (seconds, error), in order."""

    name: str
    error: str
    points: list[tuple[float, float]] = field(default_factory=list)


@dataclass
class LeftOut:
    """Skipped work: `what`, `why` it is not needed, and what was `saved`."""

    what: str
    why: str
    saved: str


@dataclass
class Stage:
    """One stage of a pipeline: `figures` are its numbers by name, JSON-ready.

    `peak_gb` is the peak memory of the process during the stage, None if unknown.
    """

    name: str
    seconds: float = 0.0
    figures: dict[str, Any] = field(default_factory=dict)
    series: list[Series] = field(default_factory=list)
    left_out: list[LeftOut] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    peak_gb: float | None = None

    def leave_out(self, what: str, why: str, saved: str) -> None:
        """Record skipped work."""
        self.left_out.append(LeftOut(what, why, saved))

    def warn(self, message: str) -> None:
        """Record a warning."""
        self.warnings.append(message)

    def take(self, other: Stage) -> None:
        """Merge the records of another stage."""
        self.figures |= other.figures
        self.series += other.series
        self.left_out += other.left_out
        self.warnings += other.warnings


@dataclass
class Report:
    """The stages of a model, in order."""

    stages: list[Stage] = field(default_factory=list)

    @contextmanager
    def stage(self, name: str) -> Iterator[Stage]:
        """Time a stage, excluding nested stages; replaces a stage of the same name."""
        stage = Stage(name)
        self.drop(name)
        self.stages.append(stage)
        before = list(self.stages)
        start = time.perf_counter()
        with peak_memory() as peak:
            try:
                yield stage
            finally:
                within = [s for s in self.stages if all(s is not other for other in before)]
                stage.seconds = time.perf_counter() - start - sum(s.seconds for s in within)
        stage.peak_gb = peak.gb

    def drop(self, name: str) -> None:
        """Remove the stage of that name, if present."""
        self.stages = [s for s in self.stages if s.name != name]

    def __getitem__(self, name: str) -> Stage:
        for stage in self.stages:
            if stage.name == name:
                return stage
        raise KeyError(f"no stage {name!r} in this report; it has {[s.name for s in self.stages]}")

    def to_dict(self) -> dict[str, Any]:
        """The report as JSON-ready data."""
        return asdict(self)

    def save(self, path: str | Path) -> None:
        """Write the report as JSON; numbers that are not finite are an error, never NaN."""
        write_json(Path(path), self.to_dict())

    @classmethod
    def load(cls, path: str | Path) -> Report:
        """Read a report, empty without a file. Raises `ValueError` for a damaged file."""
        if not Path(path).is_file():
            return cls()
        try:
            return TypeAdapter(cls).validate_json(Path(path).read_bytes())
        except ValidationError as error:
            raise ValueError(f"{path}: not a report: {sentence(error)}") from error

"""The most memory that this process held during a block, from Linux's own account of it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

_RESET, _STATUS = Path("/proc/self/clear_refs"), Path("/proc/self/status")


@dataclass(eq=False)
class Peak:
    """`gb`: resident memory of the whole process at its peak, GB; None where it is not known."""

    gb: float | None = None


_open: list[Peak] = []


@contextmanager
def peak_memory() -> Iterator[Peak]:
    """Measure the block; blocks may hold others, but not run on several threads."""
    _note()  # what came before belongs to the blocks around this one
    peak = Peak()
    _open.append(peak)
    with suppress(OSError):
        _RESET.write_text("5")
    try:
        yield peak
    finally:
        _note()
        _open.remove(peak)


def _note() -> None:
    with suppress(OSError):
        for line in _STATUS.read_text().splitlines() if _open else ():
            if line.startswith("VmHWM"):
                now = int(line.split()[1]) * 1024 / 1e9
                for peak in _open:
                    peak.gb = max(peak.gb or 0.0, now)

"""Clocks that detect a machine that slept, and a wall clock that was set."""

from __future__ import annotations

import time

JUMP_S = 2.0
"""Largest drift in seconds between wall clock and monotonic clock from one check to the next. NTP
causes milliseconds; setting the clock, or a suspend, causes more."""


def wall_seconds() -> float:
    """Seconds since 1970 by the machine's clock, which may be set."""
    return time.time()


def boot_seconds() -> float:
    """Seconds since the machine started, including suspends."""
    return time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


class ClockWatch:
    """Compares the wall clock with the monotonic clock."""

    def __init__(self) -> None:
        self._ahead = self._now()

    def jump(self) -> float | None:
        """Seconds by which the wall clock jumped since the last call; None below `JUMP_S`."""
        before, self._ahead = self._ahead, self._now()
        jumped = self._ahead - before
        return jumped if abs(jumped) > JUMP_S else None

    def _now(self) -> float:
        return wall_seconds() - time.monotonic()

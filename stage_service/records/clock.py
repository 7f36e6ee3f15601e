"""Clocks that notice what the monotonic one hides: a machine that slept, a clock that was set."""

from __future__ import annotations

import time

JUMP_S = 2.0
"""Seconds by which wall clock and monotonic clock may drift apart between two looks: a clock that
is disciplined drifts by milliseconds, one that was set or slept through a suspend by more."""


def wall_seconds() -> float:
    """Seconds since 1970 by the machine's clock, which may be set."""
    return time.time()


def boot_seconds() -> float:
    """Seconds since the machine started, those that it slept through included."""
    return time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


class ClockWatch:
    """Compares the wall clock with the monotonic one, look by look."""

    def __init__(self) -> None:
        self._ahead = self._now()

    def jump(self) -> float | None:
        """Seconds by which the wall clock jumped since the last look; None below `JUMP_S`."""
        before, self._ahead = self._ahead, self._now()
        jumped = self._ahead - before
        return jumped if abs(jumped) > JUMP_S else None

    def _now(self) -> float:
        return wall_seconds() - time.monotonic()

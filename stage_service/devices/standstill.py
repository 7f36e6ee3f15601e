"""Detects that this process, or its machine, stood still while lamps may have been lit."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Self

from stage_service.records.clock import boot_seconds


class Standstill:
    """A context that calls `found(why)` if this process did not run for `limit_s` seconds: it was
    stopped, starved, or the machine slept.

    The devices' watchdogs have put the lamps off by then, and people at the stage take them to be
    off: nothing may resume by itself. A thread of its own checks four times within the limit; call
    `check` before lighting something, because that thread may run later.
    """

    def __init__(
        self,
        limit_s: float,
        found: Callable[[str], object],
        clock: Callable[[], float] = boot_seconds,
    ) -> None:
        self._limit_s, self._found, self._clock = limit_s, found, clock
        self._last = clock()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="standstill", daemon=True)

    def __enter__(self) -> Self:
        self._last = self._clock()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def check(self) -> None:
        """Call `found` if the last check is too long ago."""
        still = self._clock() - self._last
        if still > self._limit_s:
            limit = f"watchdog_s = {self._limit_s:g}"
            self._found(f"the service stood still for {still:.3g} s, longer than {limit}")

    def _run(self) -> None:
        while not self._stop.wait(self._limit_s / 4):
            self.check()
            self._last = self._clock()

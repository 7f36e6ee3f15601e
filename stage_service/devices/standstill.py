"""Notices that this process, or its machine, stood still while something may have been lit."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Self

from stage_service.records.clock import boot_seconds


class Standstill:
    """A context in which `found(why)` is called where this process did nothing for `limit_s`
    seconds: it was stopped, starved, or the machine slept.

    Whatever was lit is dark by then, by the watchdogs of the devices, and whoever is at the stage
    takes it to be off: nothing may resume by itself afterwards. A thread of its own, which waits
    for no device, looks four times within the limit; `check` is for whoever is about to light
    something, and may be the first to run again.
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
        """Call `found` where the last look is too long ago."""
        still = self._clock() - self._last
        if still > self._limit_s:
            limit = f"watchdog_s = {self._limit_s:g}"
            self._found(f"the service stood still for {still:.3g} s, longer than {limit}")

    def _run(self) -> None:
        while not self._stop.wait(self._limit_s / 4):
            self.check()
            self._last = self._clock()

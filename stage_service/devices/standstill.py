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
    takes it to be off: nothing may go on by itself afterwards. The thread waits for no device.
    """

    def __init__(
        self,
        limit_s: float,
        found: Callable[[str], object],
        clock: Callable[[], float] = boot_seconds,
    ) -> None:
        self._limit_s, self._found, self._clock = limit_s, found, clock
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="standstill", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        last = self._clock()
        while not self._stop.wait(self._limit_s / 4):
            last, before = self._clock(), last
            if last - before > self._limit_s:
                still = f"the service stood still for {last - before:.3g} s"
                self._found(f"{still}, longer than watchdog_s = {self._limit_s:g}")

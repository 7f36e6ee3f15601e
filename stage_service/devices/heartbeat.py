"""Feeding the light bank's watchdog while lamps may be lit."""

from __future__ import annotations

import threading
from types import TracebackType
from typing import Self

from stage_service.devices.lights.interface import LightBank


class Heartbeat:
    """A context in which the bank gets a heartbeat every `interval_s` seconds.

    One failed beat is tried again at the next; `check` raises it as long as the newest failed.
    """

    def __init__(self, bank: LightBank, interval_s: float) -> None:
        self._bank = bank
        self._interval = interval_s
        self._stop = threading.Event()
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="heartbeat", daemon=True)

    def __enter__(self) -> Self:
        self._bank.heartbeat()
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stop.set()
        self._thread.join()

    def check(self) -> None:
        """Raise the newest beat's error, if it failed."""
        if self._error is not None:
            raise self._error

    def _run(self) -> None:
        while not self._stop.wait(self._interval):
            try:
                self._bank.heartbeat()
                self._error = None
            except Exception as error:  # whatever it is, the thread goes on and `check` tells
                self._error = error

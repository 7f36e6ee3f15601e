"""Feeding the watchdogs of light bank and projectors while something may be lit."""

from __future__ import annotations

import threading
from typing import Self

from stage_service.devices.lights.interface import LightBank
from stage_service.devices.projectors.interface import ProjectorController


class Heartbeat:
    """A context in which the device gets a heartbeat every `interval_s` seconds.

    `error` is that of the newest beat, None where it succeeded; `check` raises it. Each device has
    a heartbeat of its own, so that a slow one does not delay the others.
    """

    def __init__(self, device: LightBank | ProjectorController, interval_s: float) -> None:
        self._device = device
        self._interval = interval_s
        self._stop = threading.Event()
        self.error: Exception | None = None
        name = f"heartbeat of {device.name}"
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def __enter__(self) -> Self:
        self._device.heartbeat()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def check(self) -> None:
        """Raise the newest beat's error, if it failed."""
        if self.error is not None:
            raise self.error

    def _run(self) -> None:
        while not self._stop.wait(self._interval):
            try:
                self._device.heartbeat()
                self.error = None
            except Exception as error:  # raised by `check`; the thread continues
                self.error = error

"""The newest status of devices or disks, so that readers do not wait for them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

WAIT_S = 2.0
"""Seconds that a reader waits for a query that is under way."""


class CachedStatus:
    """Runs one query at a time, on a thread of its own, for any number of readers.

    `query()` returns the status, or None where it gave up; until the first result it is `initial`.
    """

    def __init__(
        self,
        query: Callable[[], dict[str, Any] | None],
        initial: dict[str, Any],
        wait_s: float = WAIT_S,
    ) -> None:
        self._query, self._status, self._wait_s = query, initial, wait_s
        self._at: float | None = None
        self._began = 0.0
        self._running = False
        self._changed = threading.Condition()

    def get(self) -> dict[str, Any]:
        """The newest status and its age in seconds, "age_s" (None before the first); starts a
        query and waits for it at most `wait_s`."""
        with self._changed:
            if not self._running:
                self._began = time.monotonic()
                with suppress(RuntimeError):  # no thread available: the status only grows older
                    threading.Thread(target=self._run, name="status-query", daemon=True).start()
                    self._running = True
            self._changed.wait_for(lambda: not self._running, self._wait_s)
            age = None if self._at is None else time.monotonic() - self._at
            return {**self._status, "age_s": age}

    def running_s(self) -> float:
        """Seconds that the present query has taken; 0 without one."""
        with self._changed:
            return time.monotonic() - self._began if self._running else 0.0

    def peek(self) -> dict[str, Any]:
        """The newest status, without a query."""
        with self._changed:
            return dict(self._status)

    def _run(self) -> None:
        status, at = None, time.monotonic()
        try:
            status = self._query()
        finally:
            with self._changed:
                if status is not None:
                    self._status, self._at = status, at
                self._running = False
                self._changed.notify_all()

"""A numbered log of events, with replay."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice
from typing import Any

from reconstruction.capture.writer import utc_now


@dataclass(frozen=True)
class Event:
    """An event: `number` counts from 1, `kind` is e.g. "capture.state"."""

    number: int
    kind: str
    time: str
    data: dict[str, Any]


class EventLog:
    """Events in order, the last `capacity` stored for replay; safe for many threads."""

    def __init__(self, capacity: int = 10_000) -> None:
        self._events: deque[Event] = deque(maxlen=capacity)
        self._changed = threading.Condition()
        self._last = 0
        self._listeners: list[Callable[[], object]] = []

    def subscribe(self, listener: Callable[[], object]) -> None:
        """Call `listener` after each event, on the publishing thread: it must not block."""
        self._listeners.append(listener)

    @property
    def last(self) -> int:
        """Number of the newest event, 0 before the first."""
        with self._changed:
            return self._last

    def publish(self, kind: str, data: dict[str, Any]) -> Event:
        """Append an event and wake waiting threads."""
        with self._changed:
            self._last += 1
            event = Event(self._last, kind, utc_now(), data)
            self._events.append(event)
            self._changed.notify_all()
        for listener in self._listeners:
            listener()
        return event

    def wait(self, number: int, timeout: float) -> list[Event]:
        """The stored events after `number`, oldest first; waits up to `timeout` seconds for one."""
        with self._changed:
            self._changed.wait_for(lambda: self._last > number, timeout)
            return self._after(number, len(self._events))

    def after(self, number: int, most: int) -> list[Event]:
        """The first `most` stored events after `number`, oldest first; does not wait."""
        with self._changed:
            return self._after(number, most)

    def _after(self, number: int, most: int) -> list[Event]:
        skipped = max(0, number - (self._last - len(self._events)))
        return list(islice(self._events, skipped, skipped + most))

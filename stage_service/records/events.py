"""A numbered log of what happened, for listeners that come and go."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass
from typing import Any

from reconstruction.capture.writer import utc_now


@dataclass(frozen=True)
class Event:
    """Something that happened: `number` counts from 1, `kind` is e.g. "capture.state"."""

    number: int
    kind: str
    time: str
    data: dict[str, Any]


class EventLog:
    """Events in order, the last `capacity` of them kept for replay; safe for many threads."""

    def __init__(self, capacity: int = 10_000) -> None:
        self._events: deque[Event] = deque(maxlen=capacity)
        self._changed = threading.Condition()
        self._last = 0

    @property
    def last(self) -> int:
        """Number of the newest event, 0 before the first."""
        with self._changed:
            return self._last

    def publish(self, kind: str, data: dict[str, Any]) -> Event:
        """Append an event and wake everyone who waits."""
        with self._changed:
            self._last += 1
            event = Event(self._last, kind, utc_now(), data)
            self._events.append(event)
            self._changed.notify_all()
            return event

    def wait(self, number: int, timeout: float) -> list[Event]:
        """The kept events after `number`, oldest first; waits up to `timeout` seconds for one."""
        with self._changed:
            self._changed.wait_for(lambda: self._last > number, timeout)
            return [e for e in self._events if e.number > number]

"""A numbered log of what happened, for listeners that come and go."""

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
        self._listeners: list[Callable[[], object]] = []

    def subscribe(self, listener: Callable[[], object]) -> None:
        """Have `listener` called after each event, by whoever published it: it must not wait."""
        self._listeners.append(listener)

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
        for listener in self._listeners:
            listener()
        return event

    def wait(self, number: int, timeout: float) -> list[Event]:
        """The kept events after `number`, oldest first; waits up to `timeout` seconds for one."""
        with self._changed:
            self._changed.wait_for(lambda: self._last > number, timeout)
            return self._after(number, len(self._events))

    def after(self, number: int, most: int) -> list[Event]:
        """The first `most` kept events after `number`, oldest first; waits for none."""
        with self._changed:
            return self._after(number, most)

    def _after(self, number: int, most: int) -> list[Event]:
        seen = max(0, number - (self._last - len(self._events)))  # of those that are kept
        return list(islice(self._events, seen, seen + most))

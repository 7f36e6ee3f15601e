"""The hold of the queue, until a person who has read its reasons releases it."""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable, Sequence
from datetime import UTC, datetime

from pydantic import BaseModel, ConfigDict, field_validator

from reconstruction.capture.writer import utc_now
from reconstruction.reading import printable
from stage_service.records.events import EventLog

MOST_REASONS = 5
"""Reasons that are stored, the newest first."""
STARTED = "the service started"
"""The first words of a start's reason; of consecutive starts the last one is stored."""


class Reason(BaseModel):
    """The reason of a hold, and its time `at` (UTC)."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    at: str
    why: str

    @field_validator("at")
    @classmethod
    def _a_time(cls, at: str) -> str:
        datetime.fromisoformat(at)
        return at


class Held(BaseModel):
    """A hold: `reasons`, the newest first; each reason makes a new `id`."""

    model_config = ConfigDict(frozen=True)

    id: str
    reasons: tuple[Reason, ...]

    @property
    def text(self) -> str:
        """The reasons in a sentence."""
        each = (f"{r.why}, {_clock(r.at)}" for r in self.reasons)
        return "; before that: ".join(each)


class HoldChanged(RuntimeError):
    """The queue is held for a reason that the caller has not read."""

    def __init__(self, held: Held) -> None:
        super().__init__(
            f"the queue is held for a reason that you have not read: {held.text}. Release that "
            f"hold, {held.id}, if queued captures may begin all the same"
        )
        self.held, self.hold = held.text, held.id


class Hold:
    """The queue's hold, set from construction, the service's start; waits for no disk.

    `changed()` is called after each change.
    """

    def __init__(self, events: EventLog, why: str = STARTED) -> None:
        self._events = events
        self._lock = threading.Lock()
        self._held: Held | None = _held([Reason(at=utc_now(), why=printable(why))])
        self.changed: Callable[[], object] = lambda: None

    @property
    def current(self) -> Held | None:
        """The present hold; None if the queue may start captures."""
        return self._held

    def recall(self, before: Sequence[Reason]) -> None:
        """Append the reasons stored by an earlier service."""
        known = [r for r in before if not r.why.startswith(STARTED)]
        with self._lock:
            if self._held is not None:
                self._held = _held([*self._held.reasons, *known])

    def set(self, why: str) -> None:
        """Hold the queue; an earlier id no longer releases it."""
        new = Reason(at=utc_now(), why=printable(why))
        with self._lock:
            before = () if self._held is None else self._held.reasons
            if before and before[0].why == new.why:  # as of a button pressed repeatedly
                before = before[1:]
            self._held = held = _held([new, *before])
        self.changed()
        self._events.publish("queue.held", {"why": why, "hold": held.id})

    def release(self, read: str) -> None:
        """Release the hold of this id. Raises `HoldChanged` for another one."""
        with self._lock:
            held = self._held
            if held is None:
                return
            if held.id != read:
                raise HoldChanged(held)
            self._held = None
        self.changed()
        self._events.publish("queue.goes_on", {"was": held.text})


def _held(reasons: Sequence[Reason]) -> Held:
    return Held(id=secrets.token_hex(4), reasons=tuple(reasons[:MOST_REASONS]))


def _clock(at: str) -> str:
    return f"{datetime.fromisoformat(at).astimezone(UTC):%Y-%m-%d %H:%M:%S} UTC"

"""The queue of captures: stored on disk and started one after the other.

The queue starts no capture that has to be armed. After a start of the service, a blackout, an
acknowledged latch, an abort, a failed capture, a jump of the clock or a standstill it is held until
a person who has read the reason releases it (`Hold`).
"""

from __future__ import annotations

import json
import logging
import secrets
import threading
from collections.abc import Callable, Collection, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

from reconstruction.capture.writer import utc_now
from reconstruction.files.durable import write_json
from reconstruction.reading import printable, read_json
from stage_service.background import Background
from stage_service.captures.hold import STARTED, Hold, Reason
from stage_service.captures.may_light import Busy, NotNow
from stage_service.records.clock import ClockWatch, boot_seconds
from stage_service.records.events import EventLog
from stage_service.records.lease import Leased

log = logging.getLogger("hairstage.queue")
POLL_S = 0.5
STOOD_STILL_S = 10.0
"""Delay of the queue's thread, in seconds, after which the service counts as having stood still."""
MOST_BYTES = 8 << 20
"""Size of all queued requests on the disk."""
MOST_HISTORY = 1000


class QueueFull(RuntimeError):
    """The queued requests already take `MOST_BYTES`."""


class UnknownEntry(LookupError):
    """The queue has no such entry: unknown, started or removed."""


class Entry(BaseModel):
    """A capture that is queued by `by`, was started as `capture`, or was removed.

    `needs_arming`: its plan flashes, so a person at the stage has to start it. `request` is stored
    while it is queued.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    id: str
    by: str
    added: str
    needs_arming: bool = False
    state: Literal["waiting", "started", "removed"] = "waiting"
    request: dict[str, Any] = {}
    capture: str | None = None
    ended: str | None = None


class _Kept(BaseModel):
    """The file."""

    model_config = ConfigDict(extra="forbid")

    held: tuple[Reason, ...] = ()
    waiting: list[Entry] = []
    history: list[Entry] = []


class CaptureQueue(Background):
    """Queued captures in the file `path`, in order; a thread of its own starts them.

    `begin(entry)` starts a capture and returns its id. `waits_for()` returns what keeps the stage
    from starting one by itself, `hold` included, or None. An error of `begin` holds the queue,
    unless the stage was not free. Holding waits for no disk. A broken file is renamed.
    """

    def __init__(
        self,
        path: Path,
        events: EventLog,
        begin: Callable[[Entry], str],
        waits_for: Callable[[], str | None],
        hold: Hold,
    ) -> None:
        super().__init__("capture-queue")
        self._path, self._events, self._hold = path, events, hold
        self._clock = ClockWatch()
        self._begin, self._stage_waits_for = begin, waits_for
        self._beginning = threading.Lock()  # one start at a time
        self._writing = threading.Lock()
        self._published: str | None = None  # the newest "queue.waits"
        self._unsaved = False
        self._kept = self._read()
        hold.recall(self._kept.held)
        hold.changed = self._hold_changed

    def start(
        self, begun: Mapping[str, str], unfinished: Collection[str], died: str | None = None
    ) -> None:
        """Start the thread. `begun` has captures by their entries' ids. The hold names the capture
        in which an earlier service `died`, or the queue's last one if it is `unfinished`."""
        with self._changed:
            for entry in list(self._kept.waiting):
                if entry.id in begun:  # the service died before it wrote the queue's file
                    self._to_history(entry, "started", begun[entry.id])
            started = (e.capture for e in reversed(self._kept.history) if e.capture is not None)
            last = next(started, None)
            if died is None and last in unfinished:
                died = last
        if died is not None:
            self._hold.set(f"{STARTED}; capture {died}, the last one, did not complete")
        self._thread.start()

    def waits_for(self) -> str | None:
        """What the first entry waits for; None: nothing, or the queue is empty."""
        with self._changed:
            first = self._kept.waiting[0] if self._kept.waiting else None
        if first is None:
            return None
        reason = self._stage_waits_for()
        if reason is None and first.needs_arming:
            reason = f"{first.id} flashes: a person at the stage has to start and arm it"
        return reason

    def waiting(self) -> list[Entry]:
        """The queued entries, the next one first."""
        with self._changed:
            return list(self._kept.waiting)

    def history(self, limit: int) -> list[Entry]:
        """The last started or removed entries, the newest first."""
        with self._changed:
            return self._kept.history[::-1][:limit]

    def add(
        self, request: dict[str, Any], by: str, *, needs_arming: bool, place: int | None = None
    ) -> Entry:
        """Queue a capture, at the end or at `place` from 0. Raises `QueueFull`, `OSError`."""
        name = f"q-{datetime.now(UTC):%Y%m%d-%H%M%S}-{secrets.token_hex(3)}"
        entry = Entry(
            id=name, by=printable(by), added=utc_now(), needs_arming=needs_arming, request=request
        )
        with self._changed:
            sizes = sum(len(json.dumps(e.request)) for e in (*self._kept.waiting, entry))
            if sizes > MOST_BYTES:
                raise QueueFull(f"queued captures may take {MOST_BYTES:,} bytes, not {sizes:,}")
            waiting = self._kept.waiting
            waiting.insert(len(waiting) if place is None else place, entry)
        try:
            self._save()
        except OSError:
            with self._changed:
                self._kept.waiting.remove(entry)
            raise
        self._publish("added", entry)
        return entry

    def move(self, name: str, place: int) -> Entry:
        """Move an entry to `place` from 0. Raises `UnknownEntry`."""
        with self._changed:
            entry = self._find(name)
            self._kept.waiting.remove(entry)
            self._kept.waiting.insert(place, entry)
        self._save()
        self._publish("moved", entry)
        return entry

    def remove(self, name: str) -> Entry:
        """Remove an entry. Raises `UnknownEntry`."""
        with self._beginning, self._changed:
            entry = self._to_history(self._find(name), "removed")
        self._save()
        self._publish("removed", entry)
        return entry

    def begin(self, name: str, begin: Callable[[Entry], str]) -> Entry:
        """Start an entry out of turn, for a person. Raises `UnknownEntry` and what `begin` does."""
        with self._beginning:
            with self._changed:
                entry = self._find(name)
            return self._begun(entry, begin(entry))

    def _hold_changed(self) -> None:
        with self._changed:
            self._unsaved = True
            self._changed.notify_all()

    def _run(self) -> None:
        late = 0.0
        while True:
            late = max(late, self._wait(lambda: self._closed or self._unsaved))
            with self._changed:
                if self._closed and not self._unsaved:
                    return
                closed = self._closed
            if late > STOOD_STILL_S:
                self._hold.set(f"the service stood still for {late:.0f} s")
            late = 0.0
            if (jump := self._clock.jump()) is not None:
                why = "it was set, or the machine slept"
                self._hold.set(f"the clock jumped by {jump:+.0f} s: {why}")
            try:
                if self._unsaved:
                    self._save()
                if not closed:
                    self._begin_the_next()
            except Exception:  # any error, as of a full disk: without this thread nothing starts
                log.exception("%s", self._path)
                if closed:
                    return
                late = self._wait(lambda: self._closed)

    def _wait(self, until: Callable[[], bool]) -> float:
        """Wait for up to `POLL_S`; returns by how many seconds it took longer than that."""
        with self._changed:
            began = boot_seconds()
            self._changed.wait_for(until, POLL_S)
            return boot_seconds() - began - POLL_S

    def _begin_the_next(self) -> None:
        with self._beginning:
            reason = self.waits_for()
            if reason != self._published:
                self._published = reason
                self._events.publish("queue.waits", {"for": reason})
            with self._changed:
                if reason is not None or not self._kept.waiting or self._closed:
                    return
                entry = self._kept.waiting[0]
            if entry.needs_arming:
                return
            try:
                capture = self._begin(entry)
            except (Busy, NotNow, Leased):
                return
            except Exception as error:  # it would be refused again: a person has to read it
                self._hold.set(f"{entry.id} cannot begin: {error}")
                return
            self._begun(entry, capture)

    def _begun(self, entry: Entry, capture: str) -> Entry:
        with self._changed:
            started = self._to_history(entry, "started", capture)
        self._publish("started", started)
        self._save()
        return started

    def _find(self, name: str) -> Entry:
        for entry in self._kept.waiting:
            if entry.id == name:
                return entry
        raise UnknownEntry(f"the queue has no entry {name!r}: it was started or removed")

    def _to_history(
        self, entry: Entry, state: Literal["started", "removed"], capture: str | None = None
    ) -> Entry:
        self._kept.waiting.remove(entry)
        over: dict[str, Any] = {
            "state": state,
            "capture": capture,
            "ended": utc_now(),
            "request": {},
        }
        ended = entry.model_copy(update=over)
        self._kept.history = [*self._kept.history, ended][-MOST_HISTORY:]
        self._unsaved = True
        return ended

    def _publish(self, what: str, entry: Entry) -> None:
        data = {"id": entry.id, "by": entry.by, "capture": entry.capture}
        self._events.publish(f"queue.{what}", data)

    def _save(self) -> None:
        with self._writing:
            with self._changed:
                held = self._hold.current
                self._kept.held = () if held is None else held.reasons
                data = self._kept.model_dump(mode="json")
                self._unsaved = False
            try:
                write_json(self._path, data)
            except OSError:
                self._unsaved = True
                raise

    def _read(self) -> _Kept:
        try:
            return _Kept.model_validate(read_json(self._path))
        except FileNotFoundError:
            return _Kept()
        except (OSError, ValueError) as error:
            aside = f"{self._path.name}.broken-{datetime.now(UTC):%Y%m%d-%H%M%S}"
            try:
                self._path.rename(self._path.with_name(aside))
            except OSError:
                log.exception("%s cannot be set aside", self._path)
            log.error("%s was broken (%s) and was set aside as %s", self._path, error, aside)
            why = f"{self._path.name} was broken and was set aside as {aside}"
            return _Kept(held=(Reason(at=utc_now(), why=why),))

"""The audit log of actions on the stage: one line of JSON each, append-only."""

from __future__ import annotations

import logging
import os
import threading
from collections import deque
from concurrent.futures import Future, wait
from contextlib import suppress
from pathlib import Path

from pydantic import BaseModel

from reconstruction.capture.writer import utc_now
from reconstruction.files.durable import flush
from reconstruction.reading import printable

log = logging.getLogger("hairstage.audit")
SERVICE = "service"
"""The actor of actions without a caller."""
MOST_WAITING = 1000
"""Lines queued for a disk that hangs, 0.5 MB; more go to the service's log alone."""


class NotRecorded(OSError):
    """A record that an action requires could not be written; the action is refused."""

    def __init__(self, what: str, path: Path, error: OSError) -> None:
        super().__init__(
            f"{what} could not be written to {path}: {error.strerror or error}. The action is "
            "refused: free space on the disk, or repair it, then try again"
        )


class Action(BaseModel):
    """`who` did `action` to `subject` (a capture's id, or the stage) at `time` (UTC).

    `result` is "ok", "refused", or the end of a long action; `detail` is the reason.
    """

    time: str
    who: str
    action: str
    subject: str
    result: str
    detail: str = ""


class AuditLog:
    """The file `path`, append-only; lines are written in the order of the calls."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._queue = threading.Lock()
        self._waiting: deque[tuple[str, Future[None]]] = deque()
        self._writing = False
        self._last: Future[None] | None = None

    def record(
        self, who: str, action: str, subject: str, result: str = "ok", detail: str = ""
    ) -> None:
        """Append an action; on the disk on return. A full disk is only logged."""
        done, mine = self._enter(who, action, subject, result, detail)
        if mine:
            self._write()
        done.result()

    def later(
        self, who: str, action: str, subject: str, result: str = "ok", detail: str = ""
    ) -> Future[None]:
        """As `record`, without waiting for the disk; the future is done once the line is
        written."""
        done, mine = self._enter(who, action, subject, result, detail)
        if mine:
            try:
                threading.Thread(target=self._write, name="audit", daemon=True).start()
            except RuntimeError:  # no thread available: the next call writes it
                self._writing = False
        return done

    def flush(self, within_s: float) -> None:
        """Wait, at most `within_s` seconds, until all lines are on the disk."""
        if self._last is not None:
            wait([self._last], within_s)

    def _enter(
        self, who: str, action: str, subject: str, result: str, detail: str
    ) -> tuple[Future[None], bool]:
        """Queue a line; returns its future, and whether the caller has to write the queue."""
        line = _line(who, action, subject, result, detail)
        done: Future[None] = Future()
        with self._queue:
            if len(self._waiting) >= MOST_WAITING:
                log.error(
                    "%s: %d lines wait for the disk; lost: %s", self._path, MOST_WAITING, line
                )
                done.set_result(None)
                return done, False
            self._waiting.append((line, done))
            self._last = done
            mine, self._writing = not self._writing, True
        return done, mine

    def _write(self) -> None:
        while True:
            with self._queue:
                if not self._waiting:
                    self._writing = False
                    return
                line, done = self._waiting.popleft()
            try:
                self._append(line)
            except OSError:
                log.exception("%s: not recorded: %s", self._path, line)
            finally:
                done.set_result(None)

    def _append(self, line: str) -> None:
        with self._lock, self._path.open("ab+") as file:
            # A line torn by a crash must not swallow this one.
            if file.tell():
                file.seek(-1, os.SEEK_END)
                line = line if file.read(1) == b"\n" else f"\n{line}"
            file.write(f"{line}\n".encode())
            file.flush()
            os.fsync(file.fileno())

    def require(self, who: str, action: str, subject: str, detail: str) -> None:
        """Append an action before it is carried out. Raises `NotRecorded`."""
        try:
            self._append(_line(who, action, subject, "ok", detail))
            flush(self._path.parent)  # the file may be new
        except OSError as error:
            raise NotRecorded(f"the record of {action}", self._path, error) from error

    def latest(self, limit: int) -> list[Action]:
        """The newest actions, oldest first; torn lines are skipped."""
        newest = []
        try:
            with self._lock, self._path.open(errors="replace") as file:
                for line in deque(file, maxlen=limit):
                    with suppress(ValueError):
                        newest.append(Action.model_validate_json(line))
        except FileNotFoundError:
            return []
        return newest


def _line(who: str, action: str, subject: str, result: str, detail: str) -> str:
    who, subject, detail = (printable(text) for text in (who, subject, detail))
    return Action(
        time=utc_now(), who=who, action=action, subject=subject, result=result, detail=detail
    ).model_dump_json()

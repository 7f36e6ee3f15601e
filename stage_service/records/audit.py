"""Who did what to the stage, and what came of it: one line of JSON each, never changed."""

from __future__ import annotations

import logging
import os
import threading
from collections import deque
from contextlib import suppress
from pathlib import Path

from pydantic import BaseModel

from reconstruction.capture.writer import utc_now
from reconstruction.reading import printable

log = logging.getLogger("hairstage.audit")
SERVICE = "service"
"""Who acts when nobody asked for it."""


class Action(BaseModel):
    """`who` did `action` to `subject` (a capture's id, or the stage) at `time` (UTC).

    `result` is "ok", "refused", or what an action that takes long came to; `detail` says why.
    """

    time: str
    who: str
    action: str
    subject: str
    result: str
    detail: str = ""


class AuditLog:
    """`path`, append-only; each line is on the disk when `record` returns."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()

    def record(
        self, who: str, action: str, subject: str, result: str = "ok", detail: str = ""
    ) -> None:
        """Append an action. A disk that is full is logged: it must not keep a lamp lit."""
        who, subject, detail = (printable(text) for text in (who, subject, detail))
        line = Action(
            time=utc_now(), who=who, action=action, subject=subject, result=result, detail=detail
        ).model_dump_json()
        try:
            with self._lock, self._path.open("ab+") as file:
                # What a crash left of a line must not swallow this one.
                if file.tell():
                    file.seek(-1, os.SEEK_END)
                    line = line if file.read(1) == b"\n" else f"\n{line}"
                file.write(f"{line}\n".encode())
                file.flush()
                os.fsync(file.fileno())
        except OSError:
            log.exception("%s: not recorded: %s", self._path, line)

    def latest(self, limit: int) -> list[Action]:
        """The newest actions, oldest of them first; a torn line is left out."""
        newest = []
        try:
            with self._lock, self._path.open(errors="replace") as file:
                for line in deque(file, maxlen=limit):
                    with suppress(ValueError):
                        newest.append(Action.model_validate_json(line))
        except FileNotFoundError:
            return []
        return newest

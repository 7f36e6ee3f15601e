"""Who did what to the stage, and what came of it: one line of JSON each, never changed."""

from __future__ import annotations

import json
import logging
import os
import threading
from collections import deque
from pathlib import Path
from typing import IO

from pydantic import BaseModel

from reconstruction.capture.writer import utc_now

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
        line = Action(
            time=utc_now(), who=who, action=action, subject=subject, result=result, detail=detail
        ).model_dump_json()
        try:
            with self._lock, self._path.open("ab+") as file:
                # What a crash left of a line must not swallow this one.
                if file.tell() and _last_byte(file) != b"\n":
                    line = f"\n{line}"
                file.write(f"{line}\n".encode())
                file.flush()
                os.fsync(file.fileno())
        except OSError:
            log.exception("%s: not recorded: %s", self._path, line)

    def latest(self, limit: int) -> list[Action]:
        """The newest actions, oldest of them first; a torn line is left out."""
        if not self._path.exists():
            return []
        newest: deque[Action] = deque(maxlen=limit)
        with self._lock, self._path.open(errors="replace") as file:
            for line in deque(file, maxlen=limit):
                try:
                    newest.append(Action(**json.loads(line)))
                except ValueError:
                    continue
        return list(newest)


def _last_byte(file: IO[bytes]) -> bytes:
    file.seek(-1, os.SEEK_END)
    return file.read(1)

"""The statuses of captures that have not changed since they were read, in one file."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

from reconstruction.files.durable import write_whole
from reconstruction.reading import parse_json
from stage_service.acquisition.states import CaptureStatus, read_status

log = logging.getLogger("hairstage.captures")
FILES = ("plan.json", "rig.json", "journal.jsonl", "manifest.json")
"""A capture's status is told by these: while they are the same files, of the same size and time, it
is the same."""
Stamp = list[list[int] | None]


class StatusIndex:
    """The statuses that `file` knows; one that cannot be used is made anew."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._known: dict[str, tuple[Stamp, Any]] | None = None
        self._lines: list[str] = []
        self._anew = False

    def status(self, folder: Path) -> CaptureStatus:
        """A folder's status, as `read_status` has it; read again only where it has changed."""
        if folder.is_symlink():  # the files that would stamp it are not looked at
            return read_status(folder)
        if self._known is None:
            self._known = _known(self._file)
        stamp = [_stamp(folder / name) for name in FILES]
        stamped, told = self._known.get(folder.name, (None, None))
        status = _status(told, folder) if stamped == stamp else None
        if status is None:
            status, self._anew = read_status(folder), True
            told = status.model_dump(mode="json")
        if status.outcome != "damaged":  # that is looked at again
            self._lines.append(json.dumps([folder.name, stamp, told]))
        return status

    def save(self) -> None:
        """Keep what was asked for, where the file lacked any of it."""
        if not self._anew:
            return
        try:
            write_whole(self._file, "\n".join(self._lines).encode())
        except OSError as error:  # a full disk: the next start takes longer
            log.warning("%s: %s", self._file, error)


def _known(index: Path) -> dict[str, tuple[Stamp, Any]]:
    try:
        lines = [parse_json(line) for line in index.read_bytes().splitlines()]
        return {str(name): (stamp, told) for name, stamp, told in lines}
    except (OSError, ValueError, TypeError) as error:
        if not isinstance(error, FileNotFoundError):
            log.warning("%s: made anew: %s", index, error)
        return {}


def _stamp(file: Path) -> list[int] | None:
    try:
        found = file.stat()
    except OSError:
        return None
    return [found.st_ino, found.st_size, found.st_mtime_ns]


def _status(told: Any, folder: Path) -> CaptureStatus | None:
    try:
        return CaptureStatus.model_validate({**told, "path": str(folder)})
    except (ValueError, TypeError):
        return None

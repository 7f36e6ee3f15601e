"""A cache of captures' statuses in one file, valid while their files are unchanged."""

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
"""The files that determine a capture's status; their inode, size and time are its stamp."""
Stamp = list[list[int] | None]


class StatusIndex:
    """The statuses cached in `file`; an unusable file is replaced."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._known: dict[str, tuple[Stamp, Any]] | None = None
        self._lines: list[str] = []
        self._changed = False

    def status(self, folder: Path) -> CaptureStatus:
        """A folder's status, as `read_status`; read again only if its files have changed."""
        if folder.is_symlink():  # nothing behind a link is read
            return read_status(folder)
        if self._known is None:
            self._known = _known(self._file)
        stamp = [_stamp(folder / name) for name in FILES]
        stamped, cached = self._known.get(folder.name, (None, None))
        status = _status(cached, folder) if stamped == stamp else None
        if status is None:
            status, self._changed = read_status(folder), True
            cached = status.model_dump(mode="json")
        if status.outcome != "damaged":  # a damaged one is read at every start
            self._lines.append(json.dumps([folder.name, stamp, cached]))
        return status

    def save(self) -> None:
        """Write the file, if any status was not in it."""
        if not self._changed:
            return
        try:
            write_whole(self._file, "\n".join(self._lines).encode())
        except OSError as error:  # a full disk: the next start is slower
            log.warning("%s: %s", self._file, error)


def _known(index: Path) -> dict[str, tuple[Stamp, Any]]:
    try:
        lines = [parse_json(line) for line in index.read_bytes().splitlines()]
        return {str(name): (stamp, status) for name, stamp, status in lines}
    except (OSError, ValueError, TypeError) as error:
        if not isinstance(error, FileNotFoundError):
            log.warning("%s: replaced: %s", index, error)
        return {}


def _stamp(file: Path) -> list[int] | None:
    try:
        found = file.stat()
    except OSError:
        return None
    return [found.st_ino, found.st_size, found.st_mtime_ns]


def _status(cached: Any, folder: Path) -> CaptureStatus | None:
    try:
        return CaptureStatus.model_validate({**cached, "path": str(folder)})
    except (ValueError, TypeError):
        return None

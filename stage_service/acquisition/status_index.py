"""The statuses of captures that have not changed since they were read, in one file."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable
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


def read_statuses(folders: Iterable[Path], index: Path) -> dict[str, CaptureStatus]:
    """Each folder's status by its name, as `read_status` has it; what `index` knows is not read
    again. `index` is written where it lacked any; one that cannot be used is made anew."""
    known, lines, found, anew = _known(index), [], {}, False
    for folder in folders:
        stamp = [_stamp(folder / name) for name in FILES]
        stamped, told = known.get(folder.name, (None, None))
        status = None
        if stamped == stamp:
            status = _status(told, folder)
        if status is None:
            status, anew = read_status(folder), True
            told = status.model_dump(mode="json")
        found[folder.name] = status
        if status.outcome != "damaged":  # that is looked at again
            lines.append(json.dumps([folder.name, stamp, told]))
    if anew:
        try:
            write_whole(index, "\n".join(lines).encode())
        except OSError as error:  # a full disk: the next start takes longer
            log.warning("%s: %s", index, error)
    return found


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

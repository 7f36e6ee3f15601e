"""The trash of one root: each entry in a folder of its own with a record.

Entries that a crash has damaged are listed, too, so that they can be deleted.
"""

from __future__ import annotations

import os
import secrets
import shutil
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict

from reconstruction.containment import inside, is_file_name
from reconstruction.files.durable import flush, write_json
from reconstruction.reading import printable, read_json
from stage_service.links import remove, target_of

Kind = Literal["capture", "model", "unknown"]
RECORD, DELETING = "removed.json", ".deleting"
"""Names in an entry: its record, and the content during a deletion."""


class Removed(BaseModel):
    """An entry of the trash, or (`name` None) one to be: "capture" or "model" `id`, removed by whom
    and when (UTC), its bytes, and the `models` made from a capture, which stay.

    `link` is its target if it is a link; `problem` why it can only be deleted, as after a crash.
    The kind is "unknown" if its record is unreadable.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str | None
    kind: Kind
    id: str
    by: str
    removed: str
    bytes: int
    models: list[str] = []
    link: str | None = None
    problem: str | None = None


class Trash:
    """The trash in `folder`. The owner locks it."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def entries(self) -> list[tuple[Path, Removed]]:
        """Each entry's folder and record, oldest first."""
        places = sorted(self._folder.iterdir()) if self._folder.is_dir() else []
        return sorted(((p, _entry(p)) for p in places), key=lambda e: e[1].removed)

    def put(self, found: Removed, thing: Path) -> Removed:
        """Move a folder, or a link, into the trash."""
        name = f"{datetime.now(UTC):%Y%m%d-%H%M%S}-{secrets.token_hex(3)}"
        place = self._folder / name
        place.mkdir(parents=True)
        try:
            write_json(place / RECORD, found.model_dump(mode="json"))
            thing.rename(place / found.id)
        except BaseException:
            shutil.rmtree(place)
            raise
        flush(place)
        flush(thing.parent)
        return found.model_copy(update={"name": name})

    def take_out(self, place: Path, found: Removed, to: Path) -> None:
        """Restore an entry to `to`."""
        (place / found.id).rename(to)
        flush(to.parent)
        remove(place)

    def delete(self, place: Path, found: Removed) -> None:
        """Delete an entry. Raises `OSError`."""
        if found.problem is None:
            (place / found.id).rename(place / DELETING)
            remove(place / DELETING)  # before the record
        remove(place)


def _entry(place: Path) -> Removed:
    removed = datetime.fromtimestamp(place.lstat().st_mtime, UTC).isoformat()
    name, link = printable(place.name), target_of(place)
    unknown = Removed(name=name, kind="unknown", id=name, by="", removed=removed, bytes=0)
    if link is not None or not place.is_dir():
        problem = "it was not put here by the service"
        return unknown.model_copy(update={"link": link, "problem": problem})
    try:
        found = Removed.model_validate(read_json(inside(place, RECORD)))
        if not is_file_name(found.id) or found.id == RECORD:
            raise ValueError(f"{RECORD}: {found.id!r} is not a name of a capture or model")
    except (OSError, ValueError) as error:
        problem = f"its record cannot be read: {printable(str(error))}"
        return unknown.model_copy(update={"problem": problem})
    if (place / DELETING).exists():
        problem = "its deletion was interrupted"
    elif not os.path.lexists(place / found.id):
        problem = "its files are not here: its removal, restoring or deletion was interrupted"
    else:
        return found.model_copy(update={"name": name})
    return found.model_copy(update={"name": name, "problem": problem})

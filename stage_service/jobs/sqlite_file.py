"""The job queue's SQLite file: one that is broken is put aside, and said to be."""

from __future__ import annotations

import logging
import sqlite3
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

log = logging.getLogger("hairstage.jobs")


def set_aside_if_broken(file: Path) -> str | None:
    """Rename a SQLite file, and what belongs to it, that is none or damaged; says what was done."""
    if not file.exists():
        return None
    reason = _broken(file)
    if reason is None:
        return None
    aside = f"{file.name}.broken-{datetime.now(UTC):%Y%m%d-%H%M%S}"
    for suffix in ("-wal", "-shm", "-journal", ""):
        part = file.with_name(file.name + suffix)
        if part.exists():
            part.rename(file.with_name(aside + suffix))
    told = (
        f"{file} was broken ({reason}) and was set aside as {aside}: its jobs are lost. "
        "Models that were begun stay as they are: restart workers, and ask for jobs anew"
    )
    log.error("%s", told)
    return told


def _broken(file: Path) -> str | None:
    """What is wrong with a SQLite file; None where it is sound, or another uses it just now."""
    try:
        with closing(sqlite3.connect(f"{file.as_uri()}?mode=rw", uri=True, timeout=30)) as database:
            (found,) = database.execute("PRAGMA quick_check(1)").fetchone()
            tables = {name for (name,) in database.execute("SELECT name FROM sqlite_master")}
    except sqlite3.OperationalError:  # locked, or not to be opened: what follows says so
        return None
    except sqlite3.DatabaseError as error:
        return str(error)
    if found != "ok":
        return str(found)
    return None if not tables or "dbos_migrations" in tables else "it is another program's"

"""The job queue's SQLite file: a broken one is renamed."""

from __future__ import annotations

import logging
import sqlite3
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

log = logging.getLogger("hairstage.jobs")


def set_aside_if_broken(file: Path) -> str | None:
    """Rename a damaged SQLite file with its side files; returns a sentence if it did."""
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
    problem = (
        f"{file} was broken ({reason}) and was renamed to {aside}: its jobs are lost. Unfinished "
        "models are kept as they are: restart the workers and submit the jobs again"
    )
    log.error("%s", problem)
    return problem


def _broken(file: Path) -> str | None:
    """What is wrong with a SQLite file; None if it is sound, or in use."""
    try:
        with closing(sqlite3.connect(f"{file.as_uri()}?mode=rw", uri=True, timeout=30)) as database:
            (found,) = database.execute("PRAGMA quick_check(1)").fetchone()
            tables = {name for (name,) in database.execute("SELECT name FROM sqlite_master")}
    except sqlite3.OperationalError:  # locked, or not readable: the next access reports it
        return None
    except sqlite3.DatabaseError as error:
        return str(error)
    if found != "ok":
        return str(found)
    return None if not tables or "dbos_migrations" in tables else "it belongs to another program"

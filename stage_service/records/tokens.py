"""Tokens and their scopes; a file has their hashes."""

from __future__ import annotations

import fcntl
import hashlib
import hmac
import json
import os
import pwd
import secrets
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Literal, get_args

from pydantic import BaseModel, ConfigDict, ValidationError

from reconstruction.capture.writer import utc_now
from reconstruction.containment import is_file_name, plain_file
from reconstruction.files.durable import flush, writing
from reconstruction.reading import read_json
from stage_service.records.polled_file import PolledFile

Scope = Literal["read", "steer", "arm", "jobs", "admin"]
SCOPES: tuple[Scope, ...] = get_args(Scope)
"""Read; shoot; arm flashes and acknowledge dark lamps; run jobs; end others' leases."""


WAIT_S = 0.5
"""Seconds that a request waits for the file's disk."""


class TokenError(ValueError):
    """A token cannot be made or revoked, or the file of tokens cannot be read."""


class UnknownToken(PermissionError):
    """There is no such token."""


class Identity(BaseModel):
    """A token's name and scopes."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    scopes: tuple[Scope, ...]


class Entry(Identity):
    """An entry of the file: the token's `sha256`, hexadecimal, made at `made` (UTC)."""

    sha256: str
    made: str


class Tokens:
    """The tokens in `path`; changes by other processes apply at once.

    `own` is one more, with every scope: that of the user who runs the service. An unreadable file
    grants nothing. While its disk hangs, the last content applies: a blackout waits for no disk.
    """

    def __init__(self, path: Path, own: str | None = None) -> None:
        self._path = path
        self._own = None if own is None else hashed(own)
        self._lock = threading.Lock()
        self._file = PolledFile[dict[str, Identity]](path, self._opened, {}, wait_s=WAIT_S)

    def find(self, token: str, within_s: float = 0.0) -> Identity | None:
        """The identity of a token, by a file that was checked within the last `within_s` s."""
        return self.behind(hashed(token), within_s)

    def behind(self, hash: str, within_s: float = 0.0) -> Identity | None:
        """The identity of the token with this hash, compared in constant time."""
        known = dict(self._file.checked(within_s))
        if self._own is not None:
            known[self._own] = Identity(name=_user(), scopes=SCOPES)
        found = None
        for own, identity in known.items():
            if hmac.compare_digest(own.encode(), hash.encode()):
                found = identity
        return found

    def entries(self) -> list[Entry]:
        """The file's entries, the oldest first. Raises `TokenError`."""
        try:
            lines = read_json(self._path) if self._path.exists() else []
            return [Entry.model_validate(line) for line in lines]
        except (OSError, ValueError, TypeError, ValidationError) as error:
            raise TokenError(f"{self._path}: {error}") from error

    def make(self, name: str, scopes: tuple[Scope, ...]) -> str:
        """Make a token; only its hash is stored. Raises `TokenError` if the name is taken."""
        with self._changing():
            entries = self.entries()
            if not is_file_name(name) or name in [e.name for e in entries]:
                raise TokenError(f"{name!r}: not a name, or there is a token of that name already")
            token = secrets.token_urlsafe(32)
            new = Entry(name=name, scopes=scopes, sha256=hashed(token), made=utc_now())
            self._write([*entries, new])
            return token

    def revoke(self, name: str) -> None:
        """Revoke a token. Raises `TokenError` if there is none of that name."""
        with self._changing():
            entries = self.entries()
            kept = [e for e in entries if e.name != name]
            if len(kept) == len(entries):
                raise TokenError(f"there is no token {name!r}; there are {[e.name for e in kept]}")
            self._write(kept)

    @contextmanager
    def _changing(self) -> Iterator[None]:
        """A context for one thread of one process at a time."""
        self._path.parent.mkdir(parents=True, exist_ok=True)
        with self._lock, self._path.with_suffix(".lock").open("a") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield

    def _opened(self) -> dict[str, Identity]:
        """Identities by hash; empty if the file is missing or unreadable."""
        with suppress(TokenError):
            return {e.sha256: Identity(name=e.name, scopes=e.scopes) for e in self.entries()}
        return {}

    def _write(self, entries: list[Entry]) -> None:
        write_secret(self._path, json.dumps([e.model_dump() for e in entries], indent=1) + "\n")
        self._file.changed()


def own_file() -> Path:
    """The file of this user's own token, which commands send to a service on this machine.

    Raises `OSError` for a user without a home.
    """
    if named := os.environ.get("HAIRSTAGE_TOKEN_FILE"):
        return Path(named)
    try:
        home = os.environ.get("XDG_CONFIG_HOME") or Path.home() / ".config"
    except RuntimeError as error:
        raise OSError(f"{error}; set HAIRSTAGE_TOKEN_FILE") from error
    return Path(home) / "hairstage" / "token"


def own_token() -> str:
    """This user's own token; made if there is none. Raises `OSError`, also for an empty file."""
    file = own_file()
    if not file.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        write_secret(file, secrets.token_urlsafe(32) + "\n")
    token = plain_file(file, most=1000).read_text().strip()
    if not token:
        raise OSError(f"{file} is empty: remove it to get a new token")
    return token


def write_secret(path: Path, text: str) -> None:
    """Write a small file that only its user may read; on the disk on return."""
    with writing(path) as temporary:
        temporary.touch(0o600)
        temporary.write_text(text)
    flush(path.parent)


def _user() -> str:
    try:
        return pwd.getpwuid(os.getuid()).pw_name
    except KeyError:  # a container's user may have no name
        return f"user {os.getuid()}"


def hashed(token: str) -> str:
    """The stored hash of a token."""
    return hashlib.sha256(token.encode()).hexdigest()

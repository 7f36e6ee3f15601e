"""Who may do what: tokens, of which a file holds the hashes."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import pwd
import secrets
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future, wait
from contextlib import contextmanager
from pathlib import Path
from typing import Literal, get_args

from pydantic import BaseModel, ConfigDict, ValidationError

from reconstruction.capture.writer import utc_now
from reconstruction.containment import is_file_name, plain_file
from reconstruction.files.durable import writing
from reconstruction.reading import read_json
from stage_service.background import beside

Scope = Literal["read", "steer", "arm", "jobs", "admin"]
SCOPES: tuple[Scope, ...] = get_args(Scope)
"""See what there is; shoot; answer for flashes and for dark lamps; process; end others' leases."""


WAIT_S = 0.5
"""How long everybody waits for a disk that does not say whose a token is."""


class TokenError(ValueError):
    """A token that cannot be made or revoked, or a file of tokens that cannot be read."""


class UnknownToken(PermissionError):
    """There is no such token, or not any more."""


class Identity(BaseModel):
    """Whose token it is, and what it opens."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    scopes: tuple[Scope, ...]


class Entry(Identity):
    """A line of the file: `sha256` is the token's, in hexadecimal. It was made at `made` (UTC)."""

    sha256: str
    made: str


class Tokens:
    """The tokens in `path`; what another process changes there counts at once.

    `own` is one more, with every scope, that stands in no file of the service: that of the user who
    runs it. A file that is there and cannot be read opens nothing. While its disk does not answer
    it is as it was last seen: whoever asks for darkness waits for no disk.
    """

    def __init__(self, path: Path, own: str | None = None) -> None:
        self._path = path
        self._own = None if own is None else hashed(own)
        self._lock = threading.Lock()
        self._read: tuple[tuple[int, int, int] | None, dict[str, Identity]] = (None, {})
        self._looking = threading.Lock()
        self._look: Future[dict[str, Identity]] | None = None
        self._until = 0.0

    def find(self, token: str) -> Identity | None:
        """Whose token this is."""
        return self.behind(hashed(token))

    def behind(self, hash: str) -> Identity | None:
        """Whose token has this hash."""
        if hash == self._own:
            return Identity(name=_user(), scopes=SCOPES)
        return self._known().get(hash)

    def entries(self) -> list[Entry]:
        """All of the file, the oldest first. Raises `TokenError`."""
        try:
            lines = read_json(self._path) if self._path.exists() else []
            return [Entry.model_validate(line) for line in lines]
        except (OSError, ValueError, TypeError, ValidationError) as error:
            raise TokenError(f"{self._path}: {error}") from error

    def make(self, name: str, scopes: tuple[Scope, ...]) -> str:
        """A new token, which is told only now. Raises `TokenError` where there is one of the name.

        Of 256 random bits a plain hash tells nothing.
        """
        with self._changing():
            entries = self.entries()
            if not is_file_name(name) or name in [e.name for e in entries]:
                raise TokenError(f"{name!r}: not a name, or there is a token of that name already")
            token = secrets.token_urlsafe(32)
            new = Entry(name=name, scopes=scopes, sha256=hashed(token), made=utc_now())
            self._write([*entries, new])
            return token

    def revoke(self, name: str) -> None:
        """End a token. Raises `TokenError` where there is none of that name."""
        with self._changing():
            entries = self.entries()
            kept = [e for e in entries if e.name != name]
            if len(kept) == len(entries):
                raise TokenError(f"there is no token {name!r}; there are {[e.name for e in kept]}")
            self._write(kept)

    @contextmanager
    def _changing(self) -> Iterator[None]:
        """For one thread of one process at a time; another's change in between would be lost."""
        self._path.parent.mkdir(parents=True, exist_ok=True)
        with self._lock, self._path.with_suffix(".lock").open("a") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield

    def _known(self) -> dict[str, Identity]:
        with self._looking:
            if self._look is None or self._look.done():
                self._look = beside(self._seen, "tokens")
                self._until = time.monotonic() + WAIT_S
            look, left = self._look, max(0.0, self._until - time.monotonic())
        return look.result() if wait([look], left).done else self._read[1]

    def _seen(self) -> dict[str, Identity]:
        try:
            found = self._path.stat()
        except OSError:
            return {}
        version = (found.st_ino, found.st_mtime_ns, found.st_size)
        if self._read[0] != version:
            try:
                entries = {e.sha256: Identity(name=e.name, scopes=e.scopes) for e in self.entries()}
            except TokenError:
                entries = {}
            self._read = (version, entries)
        return self._read[1]

    def _write(self, entries: list[Entry]) -> None:
        write_secret(self._path, json.dumps([e.model_dump() for e in entries], indent=1) + "\n")


def own_file() -> Path:
    """Where this user's own token lies, which the commands send to a service on this machine.

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
    """This user's own token; made where there is none. Raises `OSError`, also for an empty file: no
    token at all would open everything."""
    file = own_file()
    if not file.exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        write_secret(file, secrets.token_urlsafe(32) + "\n")
    token = plain_file(file, most=1000).read_text().strip()
    if not token:
        raise OSError(f"{file} is empty: remove it to have another token")
    return token


def write_secret(path: Path, text: str) -> None:
    """Write a small file that its user alone may read."""
    with writing(path) as temporary:
        temporary.touch(0o600)
        temporary.write_text(text)


def _user() -> str:
    try:
        return pwd.getpwuid(os.getuid()).pw_name
    except KeyError:  # a container's user may have no name
        return f"user {os.getuid()}"


def hashed(token: str) -> str:
    """What is kept of a token."""
    return hashlib.sha256(token.encode()).hexdigest()

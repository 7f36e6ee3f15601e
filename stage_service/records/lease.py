"""One lease at a time to steer the stage, and one service to a root folder."""

from __future__ import annotations

import fcntl
import hashlib
import logging
import os
import secrets
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import IO

from pydantic import BaseModel, ConfigDict, Field

from reconstruction.files.durable import flush, write_json
from reconstruction.reading import read_json
from stage_service.records.audit import NotRecorded
from stage_service.records.clock import boot_seconds, wall_seconds

log = logging.getLogger("hairstage.lease")
LONGEST_LEASE_S = 86400.0
"""One day: a forgotten lease blocks the stage no longer."""
NO_TOKEN = "-"
"""A digest that no token has."""


class Leased(RuntimeError):
    """Another caller holds the lease."""

    def __init__(self, lease: Lease) -> None:
        super().__init__(
            f"{lease.holder} steers the stage until {lease.expires}. Wait, or have them release "
            "the lease; abort and blackout are open to everybody"
        )
        self.holder, self.expires = lease.holder, lease.expires


class NoLease(LookupError):
    """The token's lease has expired or was released."""


@dataclass(frozen=True)
class Lease:
    """Held by `holder` until `expires` (UTC); `digest` is the SHA-256 of its token."""

    holder: str
    expires: str
    digest: str


@dataclass(frozen=True)
class GrantedLease(Lease):
    """A lease with its token, which is not stored."""

    token: str


class _Kept(BaseModel):
    """The file: the granted `seconds`, and the end `ends` by the wall clock, Unix seconds."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    holder: str
    digest: str = Field(pattern=r"^([0-9a-f]{64}|-)$")
    seconds: float = Field(ge=0.0, le=LONGEST_LEASE_S)
    ends: float = Field(ge=0.0, le=1e11)


class Leases:
    """At most one lease, stored in the file `path`; while there is one, only its token steers.

    `take` and `renew` store it before they return, or raise `NotRecorded`, so it survives a
    restart: until `expires` by the wall clock, and never longer than it was granted. An unreadable
    file may be anyone's lease: it blocks steering for `LONGEST_LEASE_S`, unless an admin ends it.
    `clock` and `wall` return seconds. Only methods that change the lease wait for the disk.
    """

    def __init__(
        self,
        path: Path,
        clock: Callable[[], float] = boot_seconds,
        wall: Callable[[], float] = wall_seconds,
    ) -> None:
        self._path, self._clock, self._wall = path, clock, wall
        self._writing = threading.Lock()
        self._lock = threading.Lock()  # for moments
        self._lease: Lease | None = None
        self._ends = 0.0
        self._read()

    @property
    def current(self) -> Lease | None:
        """The lease that has not expired."""
        with self._lock:
            return self._now()

    def take(self, holder: str, seconds: float) -> GrantedLease:
        """Begin a lease. Raises `Leased`, `NotRecorded`."""
        with self._writing:
            if (held := self.current) is not None:
                raise Leased(held)
            token = secrets.token_hex(16)
            lease = self._keep(holder, seconds, _digest(token))
            return GrantedLease(lease.holder, lease.expires, lease.digest, token)

    def renew(self, token: str, seconds: float) -> Lease:
        """Extend the lease to `seconds` from now. Raises `NoLease`, `NotRecorded`."""
        with self._writing:
            lease = self._own(token)
            return self._keep(lease.holder, seconds, lease.digest)

    def release(self, token: str) -> None:
        """End the lease. Raises `NoLease`."""
        with self._writing:
            self._own(token)
            self._forget()

    def end(self) -> Lease:
        """End any lease. Raises `NoLease` if there is none."""
        with self._writing:
            if (lease := self.current) is None:
                raise NoLease("there is no lease")
            self._forget()
            return lease

    def of_others(self, token: str | None) -> Lease | None:
        """Another caller's lease, which blocks this token; None if there is none."""
        held = self.current
        return None if held is None or _same(token, held) else held

    def check(self, token: str | None) -> None:
        """Raise `Leased` if another caller holds the lease."""
        if (held := self.of_others(token)) is not None:
            raise Leased(held)

    def holder(self, token: str | None) -> str | None:
        """The holder of this token's lease."""
        held = self.current
        return held.holder if held is not None and _same(token, held) else None

    def _now(self) -> Lease | None:
        if self._lease is not None and self._clock() >= self._ends:
            self._lease = None
        return self._lease

    def _own(self, token: str) -> Lease:
        held = self.current
        if held is None or not _same(token, held):
            raise NoLease("this lease has expired or was released: take a new one")
        return held

    def _keep(self, holder: str, seconds: float, digest: str) -> Lease:
        """Store the lease, then make it the current one. Raises `NotRecorded`; the old one
        stays."""
        ends, wall = self._clock() + seconds, self._wall() + seconds  # before the disk's delay
        kept = _Kept(holder=holder, digest=digest, seconds=seconds, ends=wall)
        self._write(kept)
        with self._lock:
            self._lease, self._ends = Lease(holder, _utc(wall), digest), ends
            return self._lease

    def _write(self, kept: _Kept) -> None:
        try:
            write_json(self._path, kept.model_dump())
            flush(self._path.parent)
        except OSError as error:
            raise NotRecorded("the lease", self._path, error) from error

    def _forget(self) -> None:
        with self._lock:
            self._lease = None
        try:
            self._path.unlink(missing_ok=True)
            flush(self._path.parent)
        except OSError:
            log.exception("%s cannot be removed: its lease returns after a restart", self._path)

    def _read(self) -> None:
        """Restore the lease of an earlier service."""
        try:
            kept = _Kept.model_validate(read_json(self._path))
        except FileNotFoundError:
            return
        except (OSError, ValueError):
            log.exception("%s: the lease cannot be read", self._path)
            holder = f"somebody unknown ({self._path.name} is damaged; an admin can end the lease)"
            ends = self._wall() + LONGEST_LEASE_S
            kept = _Kept(holder=holder, digest=NO_TOKEN, seconds=LONGEST_LEASE_S, ends=ends)
            try:
                self._write(kept)  # else it would start again with every restart
            except NotRecorded:
                log.exception("%s is left as it is", self._path)
        left = min(kept.ends - self._wall(), kept.seconds)
        if left > 0:
            self._lease = Lease(kept.holder, _utc(self._wall() + left), kept.digest)
            self._ends = self._clock() + left


def _digest(token: str) -> str:
    return hashlib.sha256(token.encode("utf-8", "backslashreplace")).hexdigest()


def _same(token: str | None, lease: Lease) -> bool:
    return token is not None and secrets.compare_digest(_digest(token), lease.digest)


def _utc(seconds: float) -> str:
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="seconds")


class LockedBy(OSError):
    """Another process holds the lock; the message is the lock file's text."""


class FileLock:
    """A lock held until `release`; the kernel frees it when the process dies. `text` names the
    holder.

    A `shared` lock may be taken by every user of the machine. `left_by` is the text of a process
    that ended without `release`. Raises `LockedBy`.
    """

    def __init__(self, path: Path, text: str, shared: bool = False) -> None:
        self._path = path
        self.left_by: str | None = None
        while True:
            self._file = _opened(path, shared)
            try:
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                with self._file:
                    raise LockedBy(self._file.read(1000).strip() or "unknown") from None
            if self._is_there():
                break
            self._file.close()  # released and removed in between
        self.left_by = self._file.read(1000).strip() or None
        # A full disk must not keep a service from starting, which darkens the stage.
        with suppress(OSError):
            os.ftruncate(self._file.fileno(), 0)
            os.pwrite(self._file.fileno(), f"{text}\n".encode(), 0)

    def release(self) -> None:
        """Release the lock."""
        if not self._file.closed:
            with suppress(OSError):  # another user's file in a shared folder
                self._path.unlink()
            self._file.close()

    def _is_there(self) -> bool:
        try:
            return os.fstat(self._file.fileno()).st_ino == self._path.stat().st_ino
        except FileNotFoundError:
            return False


def _opened(path: Path, shared: bool) -> IO[str]:
    """Open or create the file at `path`. In a shared folder, as /tmp, the kernel refuses to open
    another user's file with O_CREAT."""
    try:
        try:
            handle = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
        except FileNotFoundError:
            handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o640)
            if shared:
                os.fchmod(handle, 0o666)
    except PermissionError as error:
        raise LockedBy(f"another user, the owner of {path}") from error
    return os.fdopen(handle, "r+", errors="replace")


class RootInUse(OSError):
    """Another service uses this root folder."""


class RootLock(FileLock):
    """The lock of a service on its `root`."""

    def __init__(self, root: Path) -> None:
        try:
            super().__init__(root / "service.lock", str(os.getpid()))
        except LockedBy as error:
            raise RootInUse(
                f"{root} is in use by the service with process id {error}: two services must not "
                "drive one stage. Stop that one, or use another --root for another stage"
            ) from None

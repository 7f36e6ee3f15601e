"""Who may steer: one lease at a time, and one service to a root folder."""

from __future__ import annotations

import fcntl
import os
import secrets
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import IO


class Leased(RuntimeError):
    """Somebody else holds the lease."""

    def __init__(self, lease: Lease) -> None:
        super().__init__(
            f"{lease.holder} steers the stage until {lease.expires}. Wait, or have them release "
            "the lease; abort and blackout are open to everybody"
        )
        self.holder, self.expires = lease.holder, lease.expires


class NoLease(LookupError):
    """The token is not that of the current lease: it has expired, or was released."""


@dataclass(frozen=True)
class Lease:
    """Held by `holder` until `expires` (UTC); whoever knows `token` steers in their name."""

    token: str
    holder: str
    expires: str


class Leases:
    """At most one lease; while there is one, only its token steers. A restart forgets it."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._lease: Lease | None = None
        self._ends = 0.0

    @property
    def current(self) -> Lease | None:
        """The lease that has not expired."""
        with self._lock:
            return self._now()

    def take(self, holder: str, seconds: float) -> Lease:
        """Begin a lease. Raises `Leased`."""
        with self._lock:
            held = self._now()
            if held is not None:
                raise Leased(held)
            return self._keep(secrets.token_hex(8), holder, seconds)

    def renew(self, token: str, seconds: float) -> Lease:
        """Let the lease end so many seconds from now. Raises `NoLease`."""
        with self._lock:
            lease = self._own(token)
            return self._keep(lease.token, lease.holder, seconds)

    def release(self, token: str) -> Lease:
        """End the lease. Raises `NoLease`."""
        with self._lock:
            lease = self._own(token)
            self._lease = None
            return lease

    def end(self) -> Lease:
        """End the lease whoever holds it. Raises `NoLease` where nobody does."""
        with self._lock:
            lease, self._lease = self._now(), None
            if lease is None:
                raise NoLease("nobody holds a lease")
            return lease

    def check(self, token: str | None) -> None:
        """Raise `Leased` unless nobody holds a lease, or this token is its own."""
        with self._lock:
            held = self._now()
            if held is not None and not _same(token, held.token):
                raise Leased(held)

    def holder(self, token: str | None) -> str | None:
        """Who holds the lease of this token."""
        held = self.current
        return held.holder if held is not None and _same(token, held.token) else None

    def _now(self) -> Lease | None:
        if self._lease is not None and self._clock() >= self._ends:
            self._lease = None
        return self._lease

    def _own(self, token: str) -> Lease:
        held = self._now()
        if held is None or not _same(token, held.token):
            raise NoLease("this lease has expired or was released: take a new one")
        return held

    def _keep(self, token: str, holder: str, seconds: float) -> Lease:
        expires = datetime.now(UTC) + timedelta(seconds=seconds)
        self._ends = self._clock() + seconds
        self._lease = Lease(token, holder, expires.isoformat(timespec="seconds"))
        return self._lease


def _same(token: str | None, own: str) -> bool:
    return token is not None and secrets.compare_digest(token.encode(), own.encode())


class LockedBy(OSError):
    """Somebody else holds the lock; the message is what they left in it."""


class FileLock:
    """Held until `release`; the kernel frees it when the process dies. `text` says who holds it.

    A lock that is `shared` may be taken by every user of the machine. Raises `LockedBy`.
    """

    def __init__(self, path: Path, text: str, shared: bool = False) -> None:
        self._path = path
        while True:
            self._file = _opened(path, shared)
            try:
                fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                with self._file:
                    raise LockedBy(self._file.read(1000).strip() or "unknown") from None
            if self._is_there():
                break
            self._file.close()  # it was released, and removed, in between
        # A full disk must not keep a service from starting, which darkens: it only goes unnamed.
        with suppress(OSError):
            os.ftruncate(self._file.fileno(), 0)
            os.pwrite(self._file.fileno(), f"{text}\n".encode(), 0)

    def release(self) -> None:
        """Give it up before the process ends."""
        if not self._file.closed:
            with suppress(OSError):  # another user's file in a folder for all
                self._path.unlink()
            self._file.close()

    def _is_there(self) -> bool:
        try:
            return os.fstat(self._file.fileno()).st_ino == self._path.stat().st_ino
        except FileNotFoundError:
            return False


def _opened(path: Path, shared: bool) -> IO[str]:
    """The file at `path`, made where there is none. In a folder for all, as /tmp, the kernel lets
    nobody open another user's file who would have made it."""
    try:
        try:
            handle = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
        except FileNotFoundError:
            handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o640)
            if shared:
                os.fchmod(handle, 0o666)
    except PermissionError as error:
        raise LockedBy(f"another user, to whom {path} belongs") from error
    return os.fdopen(handle, "r+")


class RootInUse(OSError):
    """Another service drives the stage of this root folder."""


class RootLock(FileLock):
    """Held for as long as a service uses `root`."""

    def __init__(self, root: Path) -> None:
        try:
            super().__init__(root / "service.lock", str(os.getpid()))
        except LockedBy as error:
            raise RootInUse(
                f"{root} is in use by the service with process id {error}: two services must not "
                "drive one stage. Stop that one, or use another --root for another stage"
            ) from None

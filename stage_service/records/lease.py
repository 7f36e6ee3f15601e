"""Who may steer: one lease at a time, and one service to a root folder."""

from __future__ import annotations

import fcntl
import os
import secrets
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path


class Leased(RuntimeError):
    """Somebody else holds the lease."""

    def __init__(self, lease: Lease) -> None:
        super().__init__(
            f"{lease.holder} steers the stage until {lease.expires}; wait, or ask them to release "
            "the lease. Abort and blackout are open to everybody"
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
            raise NoLease(
                "this token is no lease's: it has expired or was released; take a new one"
            )
        return held

    def _keep(self, token: str, holder: str, seconds: float) -> Lease:
        expires = datetime.now(UTC) + timedelta(seconds=seconds)
        self._ends = self._clock() + seconds
        self._lease = Lease(token, holder, expires.isoformat(timespec="seconds"))
        return self._lease


def _same(token: str | None, own: str) -> bool:
    return token is not None and secrets.compare_digest(token.encode(), own.encode())


class RootInUse(OSError):
    """Another service drives the stage of this root folder."""


class RootLock:
    """Held for as long as a service uses `root`; the kernel frees it when the process dies."""

    def __init__(self, root: Path) -> None:
        path = root / "service.lock"
        self._file = path.open("a+")
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._file.seek(0)
            owner = self._file.read().strip() or "unknown"
            self._file.close()
            raise RootInUse(
                f"{root} is in use by the service with process id {owner}: two services must not "
                "drive one stage. Stop that one, or use another --root for another stage"
            ) from None
        self._file.truncate(0)
        self._file.write(f"{os.getpid()}\n")
        self._file.flush()

    def release(self) -> None:
        """Give the root up before the process ends."""
        self._file.close()

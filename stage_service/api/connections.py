"""Connections: limited so that a capture keeps enough file descriptors, and ended when idle.

A connection is in the hall until its first request identifies its owner. It then takes one of the
owner's places; without one it stays in the hall, where the longest waiting makes room for the next.
"""

from __future__ import annotations

import asyncio
import resource
import socket
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, ClassVar

from starlette.types import Scope
from uvicorn.protocols.http.h11_impl import H11Protocol

from stage_service.api.places import LIMITS, NoPlace, Owner, Places

LOOPBACK = "127.0.0.1"
HALL = 112
"""Connections without a known owner or without a place. Together with all places they are half of
the descriptors that `select`, and most systems, allow a process."""
HEADER_S = 5.0
"""Deadline for a request's headers."""
KEPT_S = 60.0
"""Keep-alive of connections with the scope `steer`, so that a blackout needs no new connection;
others have `HEADER_S`."""
STALL_S, FLOOR = 5.0, 16 << 10
"""A response is ended if the client takes fewer bytes a second over so many seconds."""
MOST_HEADER_BYTES = 16 << 10
QUEUED = 1024
"""Backlog of the listening socket."""
FILES = 8192
"""Limit of open files that a service requests."""
_NO_ROOM = (
    b"HTTP/1.1 503 Service Unavailable\r\nconnection: close\r\nretry-after: 1\r\n"
    b"content-length: 0\r\n\r\n"
)
_EXTENSION = "hairstage"


class Hall:
    """All connections of a service; those inside have none of `places` yet."""

    def __init__(self, places: Places, most: int = HALL) -> None:
        self._places, self._most = places, most
        self._inside: set[Connection] = set()
        self._owned: set[Connection] = set()
        self._watch: asyncio.TimerHandle | None = None

    def enter(self, connection: Connection) -> bool:
        """Take a new one in, if necessary in place of the longest waiting; whether it is in."""
        if self._watch is None:
            self._look()
        self._inside.add(connection)
        return len(self._inside) <= self._most or _drop_longest(self._inside - {connection})

    def lacks(self, owner: Owner) -> NoPlace | None:
        """Why this owner could get no place now, not even that of an idle connection."""
        lacks = self._places.lacks("connections", owner)
        return lacks if not any(c.idle for c in self._of(owner)) else None

    @property
    def crowded(self) -> bool:
        """Whether half of its room is taken."""
        return 2 * len(self._inside) >= self._most

    def _of(self, owner: Owner) -> Iterator[Connection]:
        return (c for c in self._owned if c.owner == owner)

    def own(self, connection: Connection, owner: Owner) -> None:
        """Give it a place of its owner, if necessary that of an idle connection. Raises
        `NoPlace`."""
        try:
            self._places.take("connections", owner)
        except NoPlace:
            if not _drop_longest(c for c in self._of(owner) if c.idle and c is not connection):
                raise
            self._places.take("connections", owner)
        self.leave(connection)
        self._owned.add(connection)
        connection.owner = owner

    def leave(self, connection: Connection) -> None:
        """Remove it and free its place."""
        self._inside.discard(connection)
        self._owned.discard(connection)
        if connection.owner is not None:
            self._places.leave("connections", connection.owner)
            connection.owner = None

    def _look(self) -> None:
        """End connections whose responses are not taken."""
        loop = asyncio.get_running_loop()
        for connection in [*self._inside, *self._owned]:
            connection.look(loop.time())
        self._watch = loop.call_later(1.0, self._look)


class Connection(H11Protocol):
    """uvicorn's connection with deadlines for headers and for taking responses, in a `hall`."""

    hall: ClassVar[Hall]
    owner: Owner | None = None
    since = 0.0
    gone = False
    parked: asyncio.Task[Any] | None = None
    """The task that waits for a place or a turn, cancelled when the connection ends."""
    _deadline: asyncio.TimerHandle | None = None
    _stalled: tuple[float, int] | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self.since = self.loop.time()
        self._expect_headers()
        if not self.hall.enter(self):
            self.hall.leave(self)
            transport.write(_NO_ROOM)
            transport.close()

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        self._expect_headers()

    def handle_events(self) -> None:
        super().handle_events()
        if self.scope is not None:
            self.scope.setdefault("extensions", {})[_EXTENSION] = {"connection": self}

    def connection_lost(self, exc: Exception | None) -> None:
        self._end()
        super().connection_lost(exc)

    def on_response_complete(self) -> None:
        self.since = self.loop.time()
        super().on_response_complete()

    def resume_writing(self) -> None:
        self._stalled = None
        super().resume_writing()

    def own(self, owner: Owner) -> None:
        """Count it as `owner`'s from now on. Raises `NoPlace`."""
        if owner != self.owner:
            self.hall.own(self, owner)
            self.timeout_keep_alive = int(KEPT_S if owner.steers else HEADER_S)

    @property
    def waits(self) -> bool:
        """Whether it has no complete request, or one that waits for its turn."""
        return self._between or self.cycle.more_body or self.parked is not None

    @property
    def idle(self) -> bool:
        """Whether it waits for its client."""
        return self.waits and self.parked is None

    @property
    def _between(self) -> bool:
        return self.cycle is None or self.cycle.response_complete

    def look(self, now: float) -> None:
        """End it if its response is not taken. Nothing is added to a stalled response, so the size
        of the buffer shows how much was taken."""
        left = self.transport.get_write_buffer_size()
        if not left or not (self.flow.write_paused or self._between):
            self._stalled = None
        elif self._stalled is None:
            self._stalled = now, left
        elif now - self._stalled[0] >= STALL_S:
            if self._stalled[1] - left < FLOOR * (now - self._stalled[0]):
                self.drop()
            else:
                self._stalled = now, left

    def drop(self) -> None:
        """End it at once."""
        self._end()
        self.connections.discard(self)
        self.transport.abort()

    def _end(self) -> None:
        self.gone = True
        self.hall.leave(self)
        self._forget_deadline()
        if self.parked is not None:
            self.parked.cancel()
            self.parked = None

    def _expect_headers(self) -> None:
        if not self._between:
            self._forget_deadline()
        elif self._deadline is None:
            self._deadline = self.loop.call_later(HEADER_S, self._too_late)

    def _too_late(self) -> None:
        self._deadline = None
        if self._between:
            self.drop()

    def _forget_deadline(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None


def _drop_longest(connections: Iterable[Connection]) -> bool:
    """Drop the longest waiting connection; whether there was one."""
    waiting = [c for c in connections if c.waits]
    longest = min(waiting, key=lambda c: c.since, default=None)
    if longest is not None:
        longest.drop()
    return longest is not None


def connection_of(scope: Scope) -> Connection | None:
    """The connection of a request; None with another server."""
    found: Connection | None = scope.get("extensions", {}).get(_EXTENSION, {}).get("connection")
    return found


def allow_files() -> None:
    """Raise this process's limit of open files to `FILES`, or as far as possible."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    most = FILES if hard == resource.RLIM_INFINITY else min(FILES, hard)
    if most > soft:
        with suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))


def files_allowed() -> int:
    """This process's limit of open files."""
    return resource.getrlimit(resource.RLIMIT_NOFILE)[0]


def share() -> float:
    """Share of all places for which this process has descriptors."""
    return min(1.0, files_allowed() / 2 / (HALL + LIMITS["connections"].all))


def protocol(places: Places) -> type[Connection]:
    """`Connection` with a new hall, sized by the number of descriptors."""
    hall = Hall(places, max(1, int(share() * HALL)))
    return type("Connection", (Connection,), {"hall": hall})


def limits(places: Places) -> dict[str, Any]:
    """Settings of uvicorn."""
    return {
        "http": protocol(places),
        "ws": "none",
        "proxy_headers": False,  # else a client on this machine can forge its address
        "timeout_keep_alive": int(HEADER_S),
        "h11_max_incomplete_event_size": MOST_HEADER_BYTES,
    }


def listening(host: str = LOOPBACK, port: int = 0, unix: Path | None = None) -> socket.socket:
    """A socket on `host`:`port` (0: any free one), or at the path `unix`, for this user and group.

    Raises `OSError` when the address is taken or there is no such port.
    """
    if unix is not None:
        return _at(unix)
    # protocol named: asyncio sets TCP_NODELAY only on connections of such a socket
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
    except OverflowError as error:
        listener.close()
        raise OSError(f"port {port}: expected 0 to 65535") from error
    except OSError as error:
        listener.close()
        raise OSError(
            f"port {port} on {host} cannot be used ({error.strerror}): stop the service that uses "
            "it, or choose another with --port"
        ) from error
    return listener


def _at(path: Path) -> socket.socket:
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        if path.is_socket():
            with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as other:
                if other.connect_ex(str(path)) == 0:
                    raise OSError(f"{path}: another service listens there: choose another --socket")
            path.unlink()  # left by a service that died
        listener.bind(str(path))
        path.chmod(0o660)
    except OSError:
        listener.close()
        raise
    return listener

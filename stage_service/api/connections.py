"""Connections: fewer than would take a capture's file descriptors, and none that only waits."""

from __future__ import annotations

import asyncio
import resource
import socket
from pathlib import Path
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

LOOPBACK = "127.0.0.1"
MOST_CONNECTIONS = 512
"""Half of the descriptors that `select`, and most systems, allow a process."""
MOST_STREAMS = 256
"""Of events, which never end: the other places are for requests."""
HEADER_S = 5.0
"""A request's headers are there within this time."""
MOST_HEADER_BYTES = 16 << 10
ACCEPTED, QUEUED = 32, 1024
"""Connections that are accepted in one turn of the event loop, some turns before they count: few,
or the descriptors run out meanwhile. And those that the kernel lets wait for that."""
_NO_ROOM = b"HTTP/1.1 503 Service Unavailable\r\nconnection: close\r\ncontent-length: 0\r\n\r\n"


class Connection(H11Protocol):
    """uvicorn's connection with a deadline for headers, and a place for each that has a request.

    Where there are `most`, a new one takes the place of the one that has waited longest for its
    request, or the rest of it: whoever holds connections open keeps nobody from a blackout.
    """

    most = MOST_CONNECTIONS
    since = 0.0
    _deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self.since = self.loop.time()
        self._expect_headers()
        if len(self.connections) <= self.most:
            return
        others = [c for c in self.connections if isinstance(c, Connection) and c.waits]
        oldest = min((c for c in others if c is not self), key=lambda c: c.since, default=None)
        if oldest is not None:
            oldest.drop()
        else:
            transport.write(_NO_ROOM)
            transport.close()

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        self._expect_headers()

    def connection_lost(self, exc: Exception | None) -> None:
        self._forget_deadline()
        super().connection_lost(exc)

    def on_response_complete(self) -> None:
        self.since = self.loop.time()
        super().on_response_complete()

    @property
    def waits(self) -> bool:
        """Whether no whole request is under way on it."""
        return self._between or self.cycle.more_body

    @property
    def _between(self) -> bool:
        return self.cycle is None or self.cycle.response_complete

    def drop(self) -> None:
        """End it, whatever it was about to say."""
        self.connections.discard(self)
        self.transport.abort()

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


def protocol() -> type[Connection]:
    """`Connection` with as many places as this process has descriptors for."""
    allowed = resource.getrlimit(resource.RLIMIT_NOFILE)[0] // 2
    return type("Connection", (Connection,), {"most": min(MOST_CONNECTIONS, allowed)})


def limits() -> dict[str, Any]:
    """What uvicorn is to be configured with."""
    return {
        "http": protocol(),
        "backlog": ACCEPTED,
        "ws": "none",
        "proxy_headers": False,  # else a client on this machine writes its own address itself
        "timeout_keep_alive": int(HEADER_S),
        "h11_max_incomplete_event_size": MOST_HEADER_BYTES,
    }


def listening(host: str = LOOPBACK, port: int = 0, unix: Path | None = None) -> socket.socket:
    """A socket on `host`:`port` (0: any free one), or at the path `unix`, for this user and group.

    Raises `OSError` when the address is taken or there is no such port.
    """
    if unix is not None:
        return _at(unix)
    # With the protocol named: asyncio sets TCP_NODELAY on what such a socket accepts and no other.
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
    except OverflowError as error:
        listener.close()
        raise OSError(f"there is no port {port}: expected one from 0 to 65535") from error
    except OSError as error:
        listener.close()
        raise OSError(
            f"port {port} on {host} cannot be used ({error.strerror}): is another service "
            "running? choose another with --port"
        ) from error
    return listener


def _at(path: Path) -> socket.socket:
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        if path.is_socket():
            with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as other:
                if other.connect_ex(str(path)) == 0:
                    raise OSError(f"{path}: another service answers there; choose another --socket")
            path.unlink()  # left by one that died
        listener.bind(str(path))
        path.chmod(0o660)
    except OSError:
        listener.close()
        raise
    return listener

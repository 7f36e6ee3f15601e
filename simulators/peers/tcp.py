"""A TCP server whose connections can be closed, and exact reads."""

from __future__ import annotations

import contextlib
import socket
import socketserver
import threading
from collections.abc import Callable
from typing import Any


class TcpServer(socketserver.ThreadingTCPServer):
    """Serves each connection with `serve(connection)` on its own thread.

    Listens at once; raises `OSError` that names `what` if the address is taken.
    """

    daemon_threads = True
    allow_reuse_address = True
    block_on_close = False

    def __init__(
        self, what: str, address: tuple[str, int], serve: Callable[[socket.socket], None]
    ) -> None:
        try:
            super().__init__(address, socketserver.BaseRequestHandler)
        except OSError as error:
            host, port = address
            raise OSError(f"{what}: cannot listen on {host}:{port}: {error}") from error
        self._serve = serve
        self._open: set[socket.socket] = set()
        self._lock = threading.Lock()
        threading.Thread(target=self.serve_forever, args=(0.02,), daemon=True).start()

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self.server_address[1])

    def finish_request(self, request: Any, client_address: Any) -> None:
        """Serve one connection; the client may go away at any time."""
        with self._lock:
            self._open.add(request)
        try:
            request.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            with contextlib.suppress(OSError):
                self._serve(request)
        finally:
            with self._lock:
                self._open.discard(request)

    def hang_up(self) -> None:
        """Close the port and every connection."""
        self.shutdown()
        self.server_close()
        with self._lock:
            for connection in self._open:
                with contextlib.suppress(OSError):
                    connection.shutdown(socket.SHUT_RDWR)


def exactly(connection: socket.socket, count: int) -> bytes:
    """That many bytes, or none if the connection has ended."""
    data = b""
    while len(data) < count:
        part = connection.recv(count - len(data))
        if not part:
            return b""
        data += part
    return data

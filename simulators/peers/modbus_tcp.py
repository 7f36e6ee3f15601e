"""Modbus on TCP: the light bank's side (Modbus Messaging on TCP/IP Implementation Guide 1.0b)."""

from __future__ import annotations

import contextlib
import socket
import socketserver
import struct
import threading
from collections.abc import Iterator

from simulators.peers.modbus_faults import DisturbedUnit

_HEADER = struct.Struct(">HHHB")  # transaction, protocol, bytes that follow, unit
_MOST = 254
_NOBODY_THERE = 0x0B


class ModbusTcpPeer:
    """Serves a unit on `port`, 0 for a free one. A host answers for itself as unit 0 and 255, too.

    Start with `start`, end with `stop`.
    """

    def __init__(self, bank: DisturbedUnit, unit: int, host: str, port: int) -> None:
        self._bank = bank
        self._units = {unit, 0, 255}
        self._address = (host, port)
        self._server: _Server | None = None
        self._stopping = threading.Event()

    def start(self) -> int:
        """Listen and return the port. Raises `OSError` when the address is taken."""
        try:
            self._server = self._listen(self._address)
        except OSError as error:
            host, port = self._address
            raise OSError(f"light bank: cannot listen on {host}:{port}: {error}") from error
        self._address = (self._address[0], self._server.socket.getsockname()[1])
        return self._address[1]

    def stop(self) -> None:
        """Close the server and every connection."""
        self._stopping.set()
        self._hang_up()

    def serve(self, connection: socket.socket) -> None:
        """Answer the requests of one connection until it ends."""
        while header := _exactly(connection, _HEADER.size):
            transaction, protocol, size, unit = _HEADER.unpack(header)
            if protocol != 0 or not 2 <= size <= _MOST:
                return
            request = _exactly(connection, size - 1)
            if not request:
                return

            def framed(answer: bytes, about: int = transaction, unit: int = unit) -> bytes:
                return _HEADER.pack(about, 0, len(answer) + 1, unit) + answer

            if unit not in self._units:
                connection.sendall(framed(bytes([request[0] | 0x80, _NOBODY_THERE])))
                continue
            reply = self._bank.reply(request, framed)
            if reply.unplugged_s is not None:
                self._hang_up()
                threading.Thread(target=self._plug_in, args=(reply.unplugged_s,)).start()
                return
            if reply.frame is not None and not self._stopping.wait(reply.delay_s):
                connection.sendall(reply.frame)

    def _listen(self, address: tuple[str, int]) -> _Server:
        server = _Server(address, self)
        threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True).start()
        return server

    def _hang_up(self) -> None:
        server, self._server = self._server, None
        if server is not None:
            server.shutdown()
            server.server_close()
            server.close_connections()

    def _plug_in(self, seconds: float) -> None:
        if not self._stopping.wait(seconds):
            self._server = self._listen(self._address)


class _Connection(socketserver.BaseRequestHandler):
    server: _Server

    def handle(self) -> None:
        with self.server.open_connection(self.request), contextlib.suppress(OSError):
            self.server.peer.serve(self.request)


class _Server(socketserver.ThreadingTCPServer):
    daemon_threads = True
    allow_reuse_address = True
    block_on_close = False

    def __init__(self, address: tuple[str, int], peer: ModbusTcpPeer) -> None:
        super().__init__(address, _Connection)
        self.peer = peer
        self._open: set[socket.socket] = set()
        self._lock = threading.Lock()

    @contextlib.contextmanager
    def open_connection(self, connection: socket.socket) -> Iterator[None]:
        with self._lock:
            self._open.add(connection)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        try:
            yield
        finally:
            with self._lock:
                self._open.discard(connection)

    def close_connections(self) -> None:
        with self._lock:
            for connection in self._open:
                with contextlib.suppress(OSError):
                    connection.shutdown(socket.SHUT_RDWR)


def _exactly(connection: socket.socket, count: int) -> bytes:
    """That many bytes, or none where the connection has ended."""
    data = b""
    while len(data) < count:
        part = connection.recv(count - len(data))
        if not part:
            return b""
        data += part
    return data

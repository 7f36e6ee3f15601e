"""Modbus on TCP: the light bank's side (Modbus Messaging on TCP/IP Implementation Guide 1.0b)."""

from __future__ import annotations

import socket
import struct
import threading

from simulators.peers.modbus_unit import DisturbedUnit
from simulators.peers.tcp import TcpServer, exactly

_HEADER = struct.Struct(">HHHB")  # transaction, protocol, bytes that follow, unit
_MOST = 254
_NOBODY_THERE = 0x0B


class ModbusTcpPeer:
    """Serves a unit on `port`, 0 for a free one, and as units 0 and 255, which address the host.

    Start with `start`, end with `stop`.
    """

    def __init__(self, bank: DisturbedUnit, unit: int, host: str, port: int) -> None:
        self._bank = bank
        self._units = {unit, 0, 255}
        self._address = (host, port)
        self._server: TcpServer | None = None
        self._stopping = threading.Event()

    def start(self) -> int:
        """Listen and return the port. Raises `OSError` when the address is taken."""
        self._listen()
        assert self._server is not None
        self._address = (self._address[0], self._server.port)
        return self._server.port

    def stop(self) -> None:
        """Close the server and every connection."""
        self._stopping.set()
        self._hang_up()

    def _serve(self, connection: socket.socket) -> None:
        """Serve the requests of one connection until it ends."""
        while header := exactly(connection, _HEADER.size):
            transaction, protocol, size, unit = _HEADER.unpack(header)
            if protocol != 0 or not 2 <= size <= _MOST:
                return
            request = exactly(connection, size - 1)
            if not request:
                return

            def framed(reply: bytes, about: int = transaction, unit: int = unit) -> bytes:
                return _HEADER.pack(about, 0, len(reply) + 1, unit) + reply

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

    def _listen(self) -> None:
        self._server = TcpServer("light bank", self._address, self._serve)

    def _hang_up(self) -> None:
        server, self._server = self._server, None
        if server is not None:
            server.hang_up()

    def _plug_in(self, seconds: float) -> None:
        if not self._stopping.wait(seconds):
            self._listen()

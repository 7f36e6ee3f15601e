"""pymodbus clients that keep one strict deadline a request, on TCP and on RTU."""

from __future__ import annotations

import os
import select
import socket
import termios
import time
from typing import Any

from pymodbus.client import ModbusSerialClient, ModbusTcpClient

from stage_service.config import ModbusRtuConfig, ModbusTcpConfig
from stage_service.devices.serial_ports import ExclusivePort

_FASTEST_FIXED = 19200
_SILENCE_S = 1.75e-3
_MOST_DRAINED = 100


def silence_s(config: ModbusRtuConfig) -> float:
    """Seconds of silence between RTU frames: 3.5 characters, fixed above 19200 baud.

    Modbus over Serial Line 1.02, section 2.5.1.1.
    """
    return _SILENCE_S if config.baud > _FASTEST_FIXED else 3.5 * character_s(config)


def character_s(config: ModbusRtuConfig) -> float:
    """Seconds that one character takes: start, 8 data bits, parity, stop bits."""
    return (9 + (config.parity != "N") + config.stop_bits) / config.baud


class _Deadline:
    """Receiving for pymodbus, which itself polls with sleeps of a millisecond and may wait twice.
    `received` is what came since the last request.

    retries=0: a command that is repeated unseen would hide a failing link, and the default of
    three multiplies every deadline by four.
    """

    socket: Any
    received = b""
    _deadline = 0.0

    def _sent(self, timeout_s: float) -> None:
        self.received = b""
        self._deadline = time.monotonic() + timeout_s

    def recv(self, size: int | None) -> bytes:
        """What there is, as soon as there is any; nothing after the deadline."""
        descriptor = self.socket.fileno()
        wait = self._deadline - time.monotonic()
        if wait <= 0 or not select.select([descriptor], [], [], wait)[0]:
            return b""
        data = os.read(descriptor, 4096)
        if not data:
            raise ConnectionResetError("the other end closed the connection")
        self.received += data
        return data


class _TcpLink(_Deadline, ModbusTcpClient):
    def __init__(self, config: ModbusTcpConfig) -> None:
        super().__init__(config.host, port=config.port, timeout=config.timeout_s, retries=0)
        self._config = config

    def connect(self) -> bool:
        if self.socket is None:
            address = (self._config.host, self._config.port)
            self.socket = socket.create_connection(address, self._config.timeout_s)
            self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return True

    def send(self, request: bytes, addr: tuple[Any, ...] | None = None) -> int:
        self._sent(self._config.timeout_s)
        self.socket.sendall(request)
        return len(request)

    def drain(self, quiet_s: float) -> None:
        """A new connection carries nothing old."""


class _RtuLink(_Deadline, ModbusSerialClient):
    def __init__(self, config: ModbusRtuConfig) -> None:
        super().__init__(config.port, timeout=config.timeout_s, retries=0)
        self._config = config
        self._quiet_since = time.monotonic()

    def connect(self) -> bool:
        if self.socket is None:
            try:
                self.socket = ExclusivePort(
                    self._config.port,
                    self._config.baud,
                    timeout_s=self._config.timeout_s,
                    parity=self._config.parity,
                    stop_bits=self._config.stop_bits,
                )
            except termios.error as error:
                raise OSError(*error.args) from error
        return True

    def send(self, request: bytes, addr: tuple[Any, ...] | None = None) -> int:
        time.sleep(max(0.0, self._quiet_since + silence_s(self._config) - time.monotonic()))
        try:
            self.socket.reset_input_buffer()  # what is there belongs to an older request
        except termios.error as error:
            raise OSError(*error.args) from error
        # The deadline is the device's: the time on the wire is on top.
        self._sent(self._config.timeout_s + len(request) * character_s(self._config))
        self.socket.write(request)
        return len(request)

    def drain(self, quiet_s: float) -> None:
        """Drop what comes until nothing has come for `quiet_s`; raises `OSError`."""
        for _ in range(_MOST_DRAINED):
            self._sent(quiet_s)
            if not self.recv(None):
                return

    def recv(self, size: int | None) -> bytes:
        data = super().recv(size)
        self._quiet_since = time.monotonic()
        return data


ModbusLink = _TcpLink | _RtuLink


def open_link(config: ModbusTcpConfig | ModbusRtuConfig) -> ModbusLink:
    """An open link; raises `OSError` with the reason."""
    link = _RtuLink(config) if isinstance(config, ModbusRtuConfig) else _TcpLink(config)
    link.connect()
    return link

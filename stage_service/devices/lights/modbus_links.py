"""Modbus links, TCP and RTU: one request at a time, each with a deadline; every byte is checked.

An RS-485 adapter may echo its own request, which looks like the reply to a write of one register.
Whether a line echoes is determined from a read, whose echo looks like no reply; the driver reads
before it trusts the reply to any write.
"""

from __future__ import annotations

import os
import select
import socket
import struct
import termios
import time
from abc import ABC, abstractmethod

from stage_service.device_config import ModbusRtuConfig, ModbusTcpConfig
from stage_service.devices.errors import DeviceError, DeviceTimeout, DeviceUnreachable
from stage_service.devices.lights import modbus_frames as frames
from stage_service.devices.serial_ports import ExclusivePort

_FASTEST_FIXED = 19200
_SILENCE_S = 1.75e-3
_MOST_DRAINED = 100
_NOISE = b"\0\xff"
"""Bytes read while an RS-485 line changes direction: addresses that no unit may have."""
_ECHO_S = 0.05
"""Wait for a reply behind bytes that may be the echo of its request."""
_HEADER = struct.Struct(">HHHB")  # transaction, protocol, bytes that follow, unit


class NoReply(Exception):
    """No reply before the deadline, but `received`; `echo`: that is the request itself."""

    def __init__(self, received: bytes, echo: bool = False) -> None:
        super().__init__(frames.unusable(received))
        self.received, self.echo = received, echo


class WrongReply(Exception):
    """A reply to another request, or surrounded by other bytes; both in words."""

    def __init__(self, expected: str, received: str) -> None:
        super().__init__(received)
        self.expected, self.received = expected, received


def no_reply(
    name: str,
    doing: str,
    error: NoReply | OSError,
    config: ModbusTcpConfig | ModbusRtuConfig,
    left: str,
) -> DeviceError:
    """The error of the bank `name` where no reply came; `left` is what becomes of its lamps."""
    todo = f"Check power and cable of the bank; {left}."
    if isinstance(error, OSError):
        got = f"none ({error})"
        return DeviceUnreachable(name, doing, "a reply", got, todo, config.timeout_s)
    got = frames.unusable(error.received)
    if error.echo:
        got = "only an echo of the request"
        if isinstance(config, ModbusRtuConfig):
            todo += f" The adapter on {config.port} echoes: switch its local echo off."
        else:
            todo = f"The device there is no light bank: check host and port; {left}."
    return DeviceTimeout(name, doing, "a reply", got, todo, config.timeout_s)


def silence_s(config: ModbusRtuConfig) -> float:
    """Seconds of silence between RTU frames: 3.5 characters, fixed above 19200 baud.

    Modbus over Serial Line 1.02, section 2.5.1.1.
    """
    return _SILENCE_S if config.baud > _FASTEST_FIXED else 3.5 * character_s(config)


def character_s(config: ModbusRtuConfig) -> float:
    """Seconds that one character takes: start, 8 data bits, parity, stop bits."""
    return (9 + (config.parity != "N") + config.stop_bits) / config.baud


class ModbusLink(ABC):
    """An open link; making one raises `OSError` with the reason.

    `echoes`: whether requests are echoed before their replies; None: not known yet, and the reply
    to a write of one register may be an echo.
    """

    echoes: bool | None = None

    @abstractmethod
    def exchange(self, request: bytes) -> bytes:
        """The reply to a request, both without frames: a right one, an exception, or one of
        another function or content. Raises `NoReply`, `WrongReply`, `OSError`."""

    @abstractmethod
    def drain(self, quiet_s: float) -> None:
        """Drop input until there is none for `quiet_s` seconds; raises `OSError`."""

    @abstractmethod
    def close(self) -> None:
        """Close it."""


class TcpLink(ModbusLink):
    """On TCP, where any byte beside the reply is an error."""

    echoes = False

    def __init__(self, config: ModbusTcpConfig) -> None:
        self._config = config
        self._transaction = 0
        self._socket = socket.create_connection((config.host, config.port), config.timeout_s)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def close(self) -> None:
        self._socket.close()

    def drain(self, quiet_s: float) -> None:
        """A new connection has no old input."""

    def exchange(self, request: bytes) -> bytes:
        config = self._config
        self._transaction = self._transaction % 0xFFFF + 1
        deadline = time.monotonic() + config.timeout_s
        early = _receive(self._socket.fileno(), 0.0)
        sent = _HEADER.pack(self._transaction, 0, len(request) + 1, config.unit) + request
        self._socket.sendall(sent)
        if early:
            raise WrongReply("nothing before the request", frames.unusable(early))
        came = b""
        while (size := self._size(came, sent)) is None or len(came) < size:
            if not (more := _receive(self._socket.fileno(), deadline - time.monotonic())):
                raise NoReply(came)
            came += more
        if len(came) > size:
            raise WrongReply("nothing behind it", frames.unusable(came[size:]))
        return came[_HEADER.size :]

    def _size(self, came: bytes, sent: bytes) -> int | None:
        """Bytes of the complete reply that starts with `came`, None if not known yet. Raises
        `WrongReply` for a header of another reply, `NoReply` for an echo."""
        request = sent[_HEADER.size :]
        if not _echo_like_reply(request):
            if came.startswith(sent):
                raise NoReply(came, echo=True)
            if sent.startswith(came):
                return None
        if len(came) <= _HEADER.size:
            return None
        header = _HEADER.unpack_from(came)
        exception = came[_HEADER.size] == request[0] | frames.EXCEPTION
        size = frames.EXCEPTION_SIZE if exception else frames.right_size(request)
        right = (self._transaction, 0, size + 1, self._config.unit)
        if header != right:
            raise WrongReply(_shown(right), _shown(header))
        return _HEADER.size + size


class RtuLink(ModbusLink):
    """On a serial line, where an adapter may echo and noise may surround a reply."""

    def __init__(self, config: ModbusRtuConfig) -> None:
        self._config = config
        self._quiet_since = time.monotonic()
        try:
            self._port = ExclusivePort(
                config.port,
                config.baud,
                timeout_s=config.timeout_s,
                parity=config.parity,
                stop_bits=config.stop_bits,
            )
        except termios.error as error:
            raise OSError(*error.args) from error

    def close(self) -> None:
        self._port.close()

    def drain(self, quiet_s: float) -> None:
        for _ in range(_MOST_DRAINED):
            if not self._more(quiet_s):
                return

    def exchange(self, request: bytes) -> bytes:
        config = self._config
        sent = frames.with_crc(bytes([config.unit]) + request)
        time.sleep(max(0.0, self._quiet_since + silence_s(config) - time.monotonic()))
        try:
            self._port.reset_input_buffer()  # of an older request
        except termios.error as error:
            raise OSError(*error.args) from error
        # The deadline is the device's: the time on the wire is on top.
        deadline = time.monotonic() + config.timeout_s + len(sent) * character_s(config)
        self._port.write(sent)
        came = b""
        while (reply := self._reply(came, sent)) is None:
            if not (more := self._more(deadline - time.monotonic())):
                raise NoReply(came, echo=came.strip(_NOISE) == sent.strip(_NOISE))
            came += more
        if self.echoes is None and reply == sent:  # or an echo, with the reply behind it
            self._more(_ECHO_S)
        return reply[1:-2]

    def _more(self, within_s: float) -> bytes:
        data = _receive(self._port.fileno(), within_s)
        self._quiet_since = time.monotonic()
        return data

    def _reply(self, came: bytes, sent: bytes) -> bytes | None:
        """The reply's frame in `came`, None while there is none; sets `echoes` once it can be
        determined. Raises `WrongReply`."""
        rest = came.lstrip(_NOISE)
        could_be = _echo_like_reply(sent[1:])
        echoed = rest.startswith(sent) and (self.echoes is True or not could_be)
        if echoed and self.echoes is not False:
            rest = rest[len(sent) :].lstrip(_NOISE)
        elif self.echoes or echoed or (not could_be and sent.startswith(rest)):
            return None
        frame = frames.rtu_frame(rest)
        if frame is None:
            return None
        behind = rest[len(frame) :].rstrip(_NOISE)
        if behind and not (self.echoes is None and could_be):
            raise WrongReply("nothing behind it", frames.unusable(behind))
        if frame[0] != self._config.unit:
            raise WrongReply(f"unit {self._config.unit}", f"unit {frame[0]}")
        if self.echoes is None and not could_be and frames.is_right(sent[1:-2], frame[1:-2]):
            self.echoes = echoed
        return frame


def open_link(config: ModbusTcpConfig | ModbusRtuConfig) -> ModbusLink:
    """An open link; raises `OSError` with the reason."""
    return RtuLink(config) if isinstance(config, ModbusRtuConfig) else TcpLink(config)


def _echo_like_reply(request: bytes) -> bool:
    """Whether the right reply equals the request, as for a write of one register."""
    return request[0] == frames.CODES["write_register"]


def _receive(descriptor: int, within_s: float) -> bytes:
    """The next bytes; empty if none came in time."""
    if not select.select([descriptor], [], [], max(0.0, within_s))[0]:
        return b""
    data = os.read(descriptor, 4096)
    if not data:
        raise ConnectionResetError("the other end closed the connection")
    return data


def _shown(header: tuple[int, ...]) -> str:
    transaction, protocol, length, unit = header
    return f"transaction {transaction}, protocol {protocol}, length {length}, unit {unit}"

"""A light bank on DMX through an Enttec DMX USB Pro (its API specification 1.44).

The widget repeats the newest frame by itself, so there is no dead-man and no read-back. After each
frame the driver requests the widget's parameters: the reply confirms the frame and has the frame
rate, so that every command can wait until its frame is out. No other request is sent, because the
widget stops its output for it. A reply is matched by its number of bytes of user configuration,
which changes with each request; other makers' widgets ignore that number, so their late replies are
waited for and dropped.
"""

from __future__ import annotations

import select
import struct
import termios
import time
from collections.abc import Iterator, Sequence

from reconstruction.geometry.rig import RigError
from stage_service.device_config import DmxConfig
from stage_service.devices.errors import DeviceTimeout, DeviceUnreachable
from stage_service.devices.lights import limits
from stage_service.devices.lights.dmx import CHANNELS, FRAME_S, DmxBank
from stage_service.devices.serial_ports import ExclusivePort

FEWEST_CHANNELS = 24
GET_PARAMETERS, SEND_DMX = 3, 6
_START, _END, _START_CODE = 0x7E, 0xE7, 0
_MOST_USER_DATA = 32
_MOST_QUIET = 4
"""Time-outs within which a widget with a missing reply must be silent for one time-out."""
_STILL_LIT = "Its lamps may still be lit."
_PARAMETERS = struct.Struct("<HBBB")  # firmware, break, mark after break, frames a second


class DmxLightBank(DmxBank):
    """The lamps of one universe; raises `RigError` where they do not fit it."""

    def __init__(self, config: DmxConfig, lamps: int) -> None:
        super().__init__(f"light bank (DMX, {config.port})", config, lamps)
        if self.universes > 1:
            raise RigError(
                f"devices.lights: {lamps} lamps of {config.channels} channels from channel "
                f"{config.first_channel} need {self.universes} universes; a DMX universe has "
                f"{CHANNELS} channels, and the widget has one"
            )
        self.config = config
        _, last = self.place(lamps - 1)
        self._channels = max(FEWEST_CHANNELS, last + config.channels)
        self._user_bytes = 0  # bytes of user configuration in the newest request
        self._bare = False  # whether the widget replies without any
        self._late = False  # whether a reply is missing
        self._sent = b""  # since the port was last read empty
        self._port: ExclusivePort | None = None

    def connect(self) -> None:
        """Open the port and check that a widget replies; `DeviceError` unless the rig file accepts
        that a blackout cannot be verified."""
        accepted = self.config.accept_unverified_blackout
        limits.refuse_unverified_blackout(self.name, self.capabilities, accepted)
        with self._lock:
            self._open()
            self._request_parameters("identifying")

    def close(self) -> None:
        """Close the port; the widget keeps repeating its last frame."""
        with self._lock:
            if self._port is not None:
                self._port.close()
            self._port = None

    def _transmit(self, frames: Sequence[bytes], doing: str) -> None:
        self._open()
        self._send(SEND_DMX, bytes([_START_CODE]) + frames[0][: self._channels], doing)
        rate = self._request_parameters(doing)
        # The frame that is on the wire ends first, then ours is sent.
        time.sleep(2 / rate if rate else 2 * FRAME_S)

    def _open(self) -> None:
        """Open the port if needed; earlier input is dropped."""
        try:
            if self._port is None:
                # The widget's USB driver ignores the baud rate.
                self._port = ExclusivePort(self.config.port, timeout_s=self.config.timeout_s)
            self._port.reset_input_buffer()
            self._sent = b""
        except (OSError, termios.error) as error:
            raise self._lost("opening the port", error) from error

    def _send(self, label: int, data: bytes, doing: str) -> None:
        assert self._port is not None
        message = struct.pack("<BBH", _START, label, len(data)) + data + bytes([_END])
        self._sent += message
        try:
            self._port.write(message)
        except OSError as error:
            raise self._lost(doing, error) from error

    def _request_parameters(self, doing: str) -> int:
        """Wait until the widget has taken everything sent; returns its frames per second, 0 for
        the fastest."""
        assert self._port is not None
        if self._late and self._bare:
            self._drain(doing)
        self._user_bytes = self._user_bytes % _MOST_USER_DATA + 1
        self._late = True
        self._send(GET_PARAMETERS, struct.pack("<H", self._user_bytes), doing)
        timeout_s = self.config.timeout_s
        deadline = time.monotonic() + timeout_s
        came = b""
        try:
            while (rate := self._frames_per_second(came)) is None:
                wait = deadline - time.monotonic()
                if wait <= 0 or not select.select([self._port], [], [], wait)[0]:
                    self.close()
                    got = came[:32].hex(" ") or "nothing"
                    todo = f"{_STILL_LIT} Check its USB cable, and that it is an Enttec USB Pro."
                    if came and self._sent.endswith(came):
                        got = "an echo of the request"
                        todo = f"{_STILL_LIT} The device at this port only echoes: check the port."
                    raise DeviceTimeout(self.name, doing, "its parameters", got, todo, timeout_s)
                came += self._port.read(max(1, self._port.in_waiting))
        except OSError as error:
            raise self._lost(doing, error) from error
        self._late = False
        return rate

    def _frames_per_second(self, data: bytes) -> int | None:
        """The rate in the reply to the newest request, where `data` holds it."""
        for user_data, rate in _replies(data):
            if user_data in (0, self._user_bytes):
                self._bare = user_data == 0
                return rate
        return None

    def _drain(self, doing: str) -> None:
        """Drop input until the widget has been silent for one time-out."""
        assert self._port is not None
        quiet = self.config.timeout_s
        deadline = time.monotonic() + _MOST_QUIET * quiet
        try:
            while select.select([self._port], [], [], quiet)[0]:
                came = self._port.read(max(1, self._port.in_waiting))
                if time.monotonic() > deadline:
                    self.close()
                    got, most = came[:32].hex(" "), _MOST_QUIET * quiet
                    todo = f"{_STILL_LIT} Disconnect its DMX input: it forwards what it receives."
                    raise DeviceTimeout(self.name, doing, "a moment's silence", got, todo, most)
        except OSError as error:
            raise self._lost(doing, error) from error

    def _lost(self, doing: str, error: Exception) -> DeviceUnreachable:
        self.close()
        todo = f"{_STILL_LIT} Plug the widget in and check the port in [devices.lights]."
        expected, timeout_s = "an open serial port", self.config.timeout_s
        return DeviceUnreachable(self.name, doing, expected, str(error), todo, timeout_s)


def _replies(data: bytes) -> Iterator[tuple[int, int]]:
    """Bytes of user configuration and frames per second of each complete reply to `GET_PARAMETERS`
    in `data`."""
    for start in range(len(data) - 4):
        first, label, size = struct.unpack_from("<BBH", data, start)
        end = start + 4 + size
        whole = end < len(data) and data[end] == _END
        if (first, label) == (_START, GET_PARAMETERS) and size >= _PARAMETERS.size and whole:
            yield size - _PARAMETERS.size, int(_PARAMETERS.unpack_from(data, start + 4)[3])

"""Requests and replies as ASCII lines on a serial port."""

from __future__ import annotations

import re
import threading
import time
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import serial

from stage_service.device_config import SerialConfig
from stage_service.devices.errors import (
    DeviceError,
    DeviceTimeout,
    DeviceUnreachable,
    SafetyRefusal,
)
from stage_service.devices.serial_ports import ExclusivePort

LONGEST_LINE = 4096
MOST_LINES = 1000
"""Lines without the expected identity after which the device counts as another one."""
REFUSED_BY_SAFETY = 3
WATCHDOG_S = (0.1, 60.0)
_PLACES = {"n": r"(\d+)", "word": "([a-z-]+)", "text": "(.+)"}
_ECHOES = "The line echoes the service's requests: switch the adapter's local echo off."


@dataclass(frozen=True)
class Identity:
    """A kind of device's reply to `ID?`: its first word, its pattern, and its description in
    errors."""

    word: str
    pattern: re.Pattern[str]
    shown: str


class SerialLines:
    """One request at a time, each with a deadline; safe to call from several threads.

    After a missed deadline or a broken reply the port is closed. The next request opens it, drops
    late input and reads until the device has identified itself, so that a late reply is never taken
    for a later one's. If that identity was itself a late one, the replies to this identification
    follow it and are dropped, too, as are echoed requests and empty lines.
    """

    def __init__(self, name: str, config: SerialConfig, identity: Identity) -> None:
        self.name = f"{name} ({config.port})"
        self.config = config
        self._identity = identity
        self._port: ExclusivePort | None = None
        self._errors_pending = 0  # replies to identifications' "?" that may still come
        self._lock = threading.RLock()

    def connect(self) -> re.Match[str]:
        """Open the port and return the match of the device's reply to `ID?`."""
        config = self.config
        with self._lock:
            self.close()
            try:
                port = ExclusivePort(config.port, config.baud, timeout_s=config.timeout_s)
            except (OSError, serial.SerialException) as error:
                doing, expected = "opening the serial port", "a free serial port"
                todo = "Check the cable, the path in the rig file and who else has it open."
                raise self._error(DeviceUnreachable, doing, expected, str(error), todo) from error
            self._port = port
            port.reset_input_buffer()
            return self._identify()

    def close(self) -> None:
        """Close the port."""
        with self._lock:
            if self._port is not None:
                self._port.close()
            self._port = None

    def request(self, request: str, reply: str, doing: str) -> re.Match[str]:
        """Send `request` and return the match of the reply, whose groups are its places.

        `reply` is a text with places in it: `<n>` a number, `<word>` small letters and hyphens,
        `<text>` anything, `<a|b>` one of these. Raises `DeviceError`: `SafetyRefusal` for the
        device's error 3.
        """
        return self._exchange(request, _pattern(reply), reply, doing)

    def _exchange(self, request: str, pattern: str, reply: str, doing: str) -> re.Match[str]:
        with self._lock:
            if self._port is None:
                self.connect()
            self._send(request, doing)
            deadline = time.monotonic() + self.config.timeout_s
            line = self._reply(request, deadline, doing)
            if match := re.fullmatch(pattern, line):
                return match
            error = re.fullmatch(r"ERR (\d+) ?(.*)", line)
            if error is None:
                self.close()  # the true reply may still be on its way
        if error is not None and int(error[1]) == REFUSED_BY_SAFETY:
            expected = f"a reply to {request!r}"
            received = f"a refusal: {error[2] or line}"
            todo = "Close the interlock and release the emergency stop at the stage."
            raise self._error(SafetyRefusal, doing, expected, received, todo)
        expected = f"a reply to {request!r} like {reply!r}"
        todo = "Check that the device follows docs/reference/wire.md and has the port to itself."
        raise self._error(DeviceError, doing, expected, repr(line), todo)

    def echo(self, request: str, doing: str) -> None:
        """`request` for commands that the device repeats in its reply."""
        self._exchange(request, re.escape(f"OK {request}"), f"OK {request}", doing)

    def set_watchdog(self, seconds: float) -> None:
        """Set the device's watchdog; raises `ValueError` outside 0.1 to 60 s."""
        low, high = WATCHDOG_S
        if not low <= seconds <= high:
            raise ValueError(
                f"{self.name}: a watchdog time is {low:g} to {high:g} s, got {seconds}"
            )
        self.echo(f"WATCHDOG {round(seconds * 1000)}", "setting the watchdog")

    def upload(
        self, words: tuple[str, str, str, str], texts: Sequence[str], most: int, steps: int
    ) -> None:
        """Upload up to `most` texts and arm the device, whose reply must have our checksum and
        number of steps. `words`: the requests for the whole and for one text, and their names."""
        begin, each, whole, parts = words
        if not 1 <= len(texts) <= most:
            doing, received = f"uploading a {whole}", f"{len(texts)} {parts}"
            expected = f"1 to {most} {parts}, which it holds"
            todo = "Shoot in shorter runs, or step by software."
            raise DeviceError(self.name, doing, expected, received, todo)
        self.echo(f"{begin} {len(texts)}", f"beginning a {whole}")
        for i, text in enumerate(texts):
            doing = f"uploading {each.lower()} {i} of the {whole}"
            self.request(f"{each} {i} {text}", f"OK {each} {i}", doing)
        crc = zlib.crc32("".join(f"{text}\n" for text in texts).encode("ascii"))
        self.request("ARM", f"OK ARM {steps} {crc:08x}", f"arming the {whole}")

    def _identify(self) -> re.Match[str]:
        doing, found = "identifying", ""
        # "?" ends a request that was cut off in the device's buffer.
        own = ("?", "ID?")
        self._send("\n".join(own), doing)
        self._errors_pending += 1
        deadline = time.monotonic() + self.config.timeout_s
        for _ in range(MOST_LINES):
            try:
                line = self._line(deadline, doing)
            except DeviceTimeout:
                if not found:
                    raise
                break
            if match := self._identity.pattern.fullmatch(line):
                return match
            if self._errors_pending and line.startswith("ERR 1"):
                self._errors_pending -= 1
            if line and (line not in own or found in ("", *own)):
                found = line
        self.close()
        expected, todo = self._identity.shown, self._advice(found, own)
        raise self._error(DeviceError, doing, expected, repr(found), todo)

    def _advice(self, found: str, own: Sequence[str]) -> str:
        """What to do about a device with this identity."""
        if found in own:
            return f"{_ECHOES} No device replies behind it: check its power and cable."
        if found.startswith(self._identity.word):
            return "Its identity is not one of docs/reference/wire.md: update its firmware."
        return "This is another device: check the ports in the rig file."

    def _reply(self, request: str, deadline: float, doing: str) -> str:
        """The first line that is neither empty, an echo, nor a reply to the identification."""
        echoed = False
        while True:
            try:
                line = self._line(deadline, doing)
            except DeviceTimeout as error:
                if not echoed:
                    raise
                received = "only an echo of the request"
                kind, todo = DeviceTimeout, f"{_ECHOES} Check the device's power and cable."
                raise self._error(kind, doing, "a reply", received, todo) from error
            echo, echoed = line == request, echoed or line == request
            if self._errors_pending and line.startswith("ERR 1"):
                self._errors_pending -= 1
            elif line and not echo and not self._identity.pattern.fullmatch(line):
                self._errors_pending = 0  # replies come in order
                return line

    def _send(self, request: str, doing: str) -> None:
        assert self._port is not None
        try:
            self._port.write(request.encode("ascii") + b"\n")
        except (OSError, serial.SerialException) as error:
            raise self._lost(doing, error) from error

    def _line(self, deadline: float, doing: str) -> str:
        """The next line; bytes outside ASCII are escaped for the error message."""
        assert self._port is not None
        data = b""
        try:
            while not data.endswith(b"\n") and len(data) < LONGEST_LINE:
                self._port.timeout = max(0.0, deadline - time.monotonic())
                got = self._port.read_until(b"\n", LONGEST_LINE - len(data))
                data += got
                if not got and time.monotonic() >= deadline:
                    break
        except (OSError, serial.SerialException) as error:
            raise self._lost(doing, error) from error
        if not data.endswith(b"\n"):
            self.close()
            received = repr(data.decode("ascii", "backslashreplace")) if data else "nothing"
            todo = "Check power and cable; the port is reopened at the next request."
            raise self._error(DeviceTimeout, doing, "a line", received, todo)
        return data.decode("ascii", "backslashreplace").strip("\r\n")

    def _lost(self, doing: str, error: Exception) -> DeviceError:
        self.close()
        todo = "The device was unplugged or its port closed: plug it in and start again."
        return self._error(DeviceUnreachable, doing, "an open serial port", str(error), todo)

    def _error(
        self, kind: type[DeviceError], doing: str, expected: str, received: str, todo: str
    ) -> DeviceError:
        return kind(self.name, doing, expected, received, todo, self.config.timeout_s)


def _pattern(reply: str) -> str:
    """The pattern of a reply with places, see `SerialLines.request`."""
    parts = re.split("<([^>]*)>", reply)
    return "".join(
        _PLACES.get(part, f"({part})") if number % 2 else re.escape(part)
        for number, part in enumerate(parts)
    )

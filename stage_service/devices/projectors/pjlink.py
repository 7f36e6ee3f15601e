"""Power and lamp hours of a projector on PJLink class 1; never a part of a capture's timing.

Source: PJLink Specifications, version 1.04 (10 December 2013), JBMIA: the commands POWR and LAMP
and the authentication. `docs/reference/wire.md` has what is used of it.
"""

from __future__ import annotations

import hashlib
import re
import socket
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path
from typing import NoReturn

from stage_service.devices.errors import DeviceError, DeviceTimeout, DeviceUnreachable

PORT = 4352
_LONGEST_LINE = 136
_ERRORS = {
    "1": ("ERR1, an undefined command", "The projector does not offer this; use its own panel."),
    "2": ("ERR2, a parameter out of range", "The projector does not offer this state."),
    "3": ("ERR3, not available now", "It is starting, cooling down or busy: try again later."),
    "4": ("ERR4, a failure of the projector", "Look at the projector's own display and lamps."),
}


class Power(IntEnum):
    """A projector's power state."""

    STANDBY = 0
    ON = 1
    COOLING = 2
    WARM_UP = 3


@dataclass(frozen=True)
class Lamp:
    """One lamp: its hours so far and whether it is lit."""

    hours: int
    lit: bool


class ProjectorBusy(DeviceError):
    """The projector is temporarily unable to do this (ERR3)."""


@dataclass(frozen=True)
class PjLinkProjector:
    """One projector; `password` is a text or the file that holds it, empty where there is none.
    Safe to call from several threads.

    Every exchange has a connection of its own, because projectors drop idle ones, and ends within
    `timeout_s`. Raises `DeviceError`:
    `DeviceTimeout` for a missed deadline, `DeviceUnreachable` for a connection refused or lost,
    `ProjectorBusy` for ERR3.
    """

    projector: str
    host: str
    port: int = PORT
    password: str | Path = field(default="", repr=False)
    timeout_s: float = 5.0

    @property
    def name(self) -> str:
        """The name in errors."""
        return f"projector {self.projector} (PJLink {self.host}:{self.port})"

    def power(self) -> Power:
        """The power state that it reports."""
        return Power(
            int(self._request("POWR ?", "[0-3]", "0, 1, 2 or 3", "reading the power state"))
        )

    def lamps(self) -> tuple[Lamp, ...]:
        """Hours of each lamp; empty where it counts none (ERR1)."""
        doing = "reading the lamp hours"
        pattern = r"\d{1,5} [01](?: \d{1,5} [01]){0,7}|ERR1"
        shown = "hours and 0 or 1 for each of up to 8 lamps"
        reply = self._request("LAMP ?", pattern, shown, doing)
        if reply == "ERR1":
            return ()
        words = reply.split(" ")
        pairs = zip(words[::2], words[1::2], strict=True)
        return tuple(Lamp(int(hours), lit == "1") for hours, lit in pairs)

    def switch(self, on: bool) -> None:
        """Request power on or standby. OK means accepted: `power` shows when it is reached."""
        self._request(f"POWR {on:d}", "OK", "OK", f"switching the power {'on' if on else 'off'}")

    def _request(self, command: str, pattern: str, shown: str, doing: str) -> str:
        """Send `command` and return what follows `=` in its reply: a match of `pattern`, which
        errors describe as `shown`."""
        deadline, line, sent = time.monotonic() + self.timeout_s, "", ""
        try:
            with socket.create_connection((self.host, self.port), self.timeout_s) as link:
                lines = _lines(link, deadline)
                sent = f"{self._digest(next(lines), doing)}%1{command}"
                link.settimeout(_left(deadline))
                link.sendall(f"{sent}\r".encode("ascii"))
                while line in ("", sent):  # an echo
                    line = next(lines)
        except _Incomplete as cut:
            received = f"{cut}, and the connection was closed"
            todo = "The projector takes few connections at once: check what else uses it."
            expected = "a reply that ends in CR"
            raise self._error(DeviceUnreachable, doing, expected, received, todo) from cut
        except TimeoutError as error:
            todo = "Check the projector's network standby setting, cable and address."
            received = "only an echo of the command" if line else str(error)
            raise self._error(DeviceTimeout, doing, "a reply", received, todo) from error
        except OSError as error:
            todo = "Check address, network and that PJLink is enabled in the projector."
            raise self._error(DeviceUnreachable, doing, "a connection", str(error), todo) from error
        if re.fullmatch("PJLINK ERRA", line, re.IGNORECASE):
            self._not_authenticated("ERRA: the password is wrong", doing)
        match = re.fullmatch(rf"%1{command[:4]}=({pattern})", line, re.IGNORECASE)
        if match is not None:
            return match[1].upper()
        number = re.fullmatch(rf"%1{command[:4]}=ERR([1-4])", line, re.IGNORECASE)
        other = (repr(line), "Check that this is a PJLink port and nothing stands in between.")
        received, todo = _ERRORS[number[1]] if number else other
        kind = ProjectorBusy if number and number[1] == "3" else DeviceError
        raise self._error(kind, doing, f"%1{command[:4]}= and {shown}", received, todo)

    def _digest(self, greeting: str, doing: str) -> str:
        """The prefix of the first command: empty, or the MD5 digest."""
        match = re.fullmatch(r"PJLINK (?:0|1 ([0-9a-f]{8}))", greeting, re.IGNORECASE)
        if match is None:
            if re.fullmatch("PJLINK ERRA", greeting, re.IGNORECASE):
                self._not_authenticated("ERRA", doing)
            expected = "a greeting like PJLINK 0 or PJLINK 1 and 8 hexadecimal digits"
            todo = "This is another service: check host and port."
            raise self._error(DeviceError, doing, expected, repr(greeting), todo)
        if match[1] is None:
            return ""
        password = self._password(doing)
        if not password:
            self._not_authenticated("a greeting that requests one", doing)
        # The protocol prescribes MD5; it only keeps the password off the wire.
        text = (match[1] + password).encode()
        return hashlib.md5(text, usedforsecurity=False).hexdigest()

    def _password(self, doing: str) -> str:
        if isinstance(self.password, str):
            return self.password
        try:
            return self.password.read_text().strip()
        except (OSError, ValueError) as error:
            expected = "the file with its password"
            todo = "Put the password there, or correct password_file in the rig file."
            raise DeviceError(self.name, doing, expected, str(error), todo) from error

    def _not_authenticated(self, received: str, doing: str) -> NoReturn:
        todo = "Set the projector's PJLink password where the rig file says."
        raise self._error(DeviceError, doing, "the right password", received, todo)

    def _error(
        self, kind: type[DeviceError], doing: str, expected: str, received: str, todo: str
    ) -> DeviceError:
        return kind(self.name, doing, expected, received, todo, self.timeout_s)


class _Incomplete(Exception):
    """The connection was closed before the end of a line."""


def _left(deadline: float) -> float:
    left = deadline - time.monotonic()
    if left <= 0:
        raise TimeoutError("nothing")
    return left


def _lines(link: socket.socket, deadline: float) -> Iterator[str]:
    """Lines without a line feed before them; bytes outside ASCII are escaped for the error
    message."""
    data = b""
    while True:
        while b"\r" not in data and len(data) < _LONGEST_LINE:
            try:
                link.settimeout(_left(deadline))
                got = link.recv(_LONGEST_LINE)
            except TimeoutError:
                raise TimeoutError(_shown(data)) from None
            if not got:
                raise _Incomplete(_shown(data))
            data += got
        line, _, data = data.partition(b"\r")
        yield line.decode("ascii", "backslashreplace").removeprefix("\n")


def _shown(data: bytes) -> str:
    return repr(data.decode("ascii", "backslashreplace")) if data else "nothing"

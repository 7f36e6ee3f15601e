"""A device on a serial port: ASCII lines on a pseudo-terminal."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from simulators.peers.faults import Fault
from simulators.peers.terminal import TerminalPeer

_LONGEST_LINE = 96
_NOISE = b"\xff\x00\x1b[A~~\n"


class Refusal(Exception):
    """A request with the reply `ERR <code> <text>`."""

    def __init__(self, code: int, text: str) -> None:
        super().__init__(text)
        self.code = code


UNKNOWN, BAD_ARGUMENT, UNSAFE, NOT_NOW = 1, 2, 3, 4
WATCHDOG_MS = (100, 60_000)


class SerialPeer(TerminalPeer):
    """Replies to each line with `reply(line)`, which may raise `Refusal`; `strikes(line)` is the
    fault of a request."""

    def __init__(
        self,
        link: Path,
        reply: Callable[[str], str],
        strikes: Callable[[str], Fault | None] = lambda _line: None,
    ) -> None:
        self._reply, self._strikes = reply, strikes
        super().__init__(link)

    def _run(self) -> None:
        pending = b""
        while (data := self._terminal.receive()) is not None:
            *lines, pending = (pending + data).split(b"\n")
            # the tail of a too long line must not be taken for a request
            pending = pending[: _LONGEST_LINE + 1]
            for line in lines:
                if not self._handle(line):
                    pending = b""
                    break

    def _handle(self, line: bytes) -> bool:
        """Reply to one request; False if the port is unplugged or the peer stops."""
        text = line.decode("ascii", "backslashreplace").rstrip("\r")
        fault = self._strikes(text)
        kind = None if fault is None else fault.kind
        if fault is not None and kind == "unplug":
            self._terminal.unplug(fault.seconds)
            return False
        reply = f"ERR {NOT_NOW} busy" if kind == "nak" else self._reply_to(line)
        if fault is not None and kind == "late" and self._terminal.stops_within(fault.seconds):
            return False
        if kind == "garbage":
            reply = f"{reply[0]}\x7f{reply[2:]}"
        if kind != "silent":
            self._terminal.send((_NOISE if kind == "noise" else b"") + reply.encode() + b"\n")
        return True

    def _reply_to(self, line: bytes) -> str:
        if len(line.rstrip(b"\r")) > _LONGEST_LINE:
            return f"ERR {UNKNOWN} line too long"
        try:
            return self._reply(line.decode("ascii").rstrip("\r"))
        except UnicodeDecodeError:
            return f"ERR {UNKNOWN} not ASCII"
        except Refusal as refusal:
            return f"ERR {refusal.code} {refusal}"


def whole(text: str, low: int, high: int, what: str) -> int:
    """`text` as an integer from `low` to `high`; raises `Refusal`."""
    if not (text.isascii() and text.isdecimal()) or not low <= int(text) <= high:
        raise Refusal(BAD_ARGUMENT, f"{what} must be a whole number {low} to {high}")
    return int(text)

"""A device on a serial port: ASCII lines on a pseudo-terminal."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from simulators.peers.faults import Fault
from simulators.peers.terminal import TerminalPeer

_LONGEST_LINE = 96
_NOISE = b"\xff\x00\x1b[A~~\n"


class Refusal(Exception):
    """A request that is answered with `ERR <code> <text>`."""

    def __init__(self, code: int, text: str) -> None:
        super().__init__(text)
        self.code = code


UNKNOWN, BAD_ARGUMENT, UNSAFE, NOT_NOW = 1, 2, 3, 4
WATCHDOG_MS = (100, 60_000)


class SerialPeer(TerminalPeer):
    """Answers each line with `reply(line)`, which returns the answer or raises `Refusal`.

    `strikes(line)` is the wire's fault at this request.
    """

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
            # Of a line that is too long the tail must not pass for a request.
            pending = pending[: _LONGEST_LINE + 1]
            for line in lines:
                if not self._handle(line):
                    pending = b""
                    break

    def _handle(self, line: bytes) -> bool:
        """Answer one request; False where the port went away or the peer is to stop."""
        text = line.decode("ascii", "backslashreplace").rstrip("\r")
        fault = self._strikes(text)
        kind = None if fault is None else fault.kind
        if fault is not None and kind == "unplug":
            self._terminal.unplug(fault.seconds)
            return False
        answer = f"ERR {NOT_NOW} busy" if kind == "nak" else self._answer(line)
        if fault is not None and kind == "late" and self._terminal.stops_within(fault.seconds):
            return False
        if kind == "garbage":
            answer = f"{answer[0]}\x7f{answer[2:]}"
        if kind != "silent":
            self._terminal.send((_NOISE if kind == "noise" else b"") + answer.encode() + b"\n")
        return True

    def _answer(self, line: bytes) -> str:
        if len(line.rstrip(b"\r")) > _LONGEST_LINE:
            return f"ERR {UNKNOWN} line too long"
        try:
            return self._reply(line.decode("ascii").rstrip("\r"))
        except UnicodeDecodeError:
            return f"ERR {UNKNOWN} not ASCII"
        except Refusal as refusal:
            return f"ERR {refusal.code} {refusal}"


def whole(text: str, low: int, high: int, what: str) -> int:
    """`text` as a whole number from `low` to `high`; raises `Refusal`."""
    if not (text.isascii() and text.isdecimal()) or not low <= int(text) <= high:
        raise Refusal(BAD_ARGUMENT, f"{what} must be a whole number {low} to {high}")
    return int(text)

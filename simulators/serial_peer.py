"""A device on a serial port: ASCII lines on a pseudo-terminal."""

from __future__ import annotations

import os
import select
import threading
import tty
from collections.abc import Callable
from pathlib import Path

from simulators.faults import Fault

_LONGEST_LINE = 96
_NOISE = b"\xff\x00\x1b[A~~\n"


class Refusal(Exception):
    """A request that is answered with `ERR <code> <text>`."""

    def __init__(self, code: int, text: str) -> None:
        super().__init__(text)
        self.code = code


UNKNOWN, BAD_ARGUMENT, UNSAFE, NOT_NOW = 1, 2, 3, 4
WATCHDOG_MS = (100, 60_000)


class SerialPeer:
    """Answers each line with `reply(line)` at a pseudo-terminal that `link` points to.

    `reply` returns the answer or raises `Refusal`; `strikes(line)` is the wire's fault at this
    request. The link is made by `start` and removed by `stop`.
    """

    def __init__(
        self,
        link: Path,
        reply: Callable[[str], str],
        strikes: Callable[[str], Fault | None] = lambda _line: None,
    ) -> None:
        self.link = link
        self._reply = reply
        self._strikes = strikes
        self._near, self._far = _terminal()
        self._wake_read, self._wake_write = os.pipe()
        self._thread = threading.Thread(target=self._run, name=link.name, daemon=True)

    @property
    def path(self) -> str:
        """The device path behind the link."""
        return os.ttyname(self._far)

    def start(self) -> None:
        """Make the link and answer from now on."""
        self._make_link()
        self._thread.start()

    def stop(self) -> None:
        """Remove the link and close the terminal."""
        os.write(self._wake_write, b"x")
        self._thread.join()
        self._remove_link()
        for end in (self._near, self._far, self._wake_read, self._wake_write):
            os.close(end)

    def _make_link(self) -> None:
        fresh = self.link.with_name(self.link.name + ".new")
        fresh.unlink(missing_ok=True)
        fresh.symlink_to(self.path)
        fresh.replace(self.link)

    def _remove_link(self) -> None:
        if self.link.is_symlink() and str(self.link.readlink()) == self.path:
            self.link.unlink()

    def _run(self) -> None:
        pending = b""
        while True:
            ready, _, _ = select.select([self._near, self._wake_read], [], [])
            if self._wake_read in ready:
                return
            pending += os.read(self._near, 4096)
            *lines, pending = pending.split(b"\n")
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
            return self._unplug(fault.seconds)
        answer = f"ERR {NOT_NOW} busy" if kind == "nak" else self._answer(line)
        if fault is not None and kind == "late" and self._stops_within(fault.seconds):
            return False
        if kind == "garbage":
            answer = f"{answer[0]}\x7f{answer[2:]}"
        if kind != "silent":
            os.write(self._near, (_NOISE if kind == "noise" else b"") + answer.encode() + b"\n")
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

    def _unplug(self, seconds: float) -> bool:
        """Close the terminal and make another one later; False, as the request is lost."""
        self._remove_link()
        os.close(self._near)
        os.close(self._far)
        gone = self._stops_within(seconds)
        self._near, self._far = _terminal()
        if not gone:
            self._make_link()
        return False

    def _stops_within(self, seconds: float) -> bool:
        ready, _, _ = select.select([self._wake_read], [], [], seconds)
        return bool(ready)


def _terminal() -> tuple[int, int]:
    """Both ends. The far one stays open here, or the near one would fail between two clients."""
    near, far = os.openpty()
    tty.setraw(far)
    return near, far


def whole(text: str, low: int, high: int, what: str) -> int:
    """`text` as a whole number from `low` to `high`; raises `Refusal`."""
    if not (text.isascii() and text.isdecimal()) or not low <= int(text) <= high:
        raise Refusal(BAD_ARGUMENT, f"{what} must be a whole number {low} to {high}")
    return int(text)

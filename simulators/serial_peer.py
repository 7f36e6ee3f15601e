"""A device on a serial port: ASCII lines on a pseudo-terminal."""

from __future__ import annotations

import os
import select
import threading
import tty
from collections.abc import Callable
from pathlib import Path

_LONGEST_LINE = 4096


class Refusal(Exception):
    """A request that is answered with `ERR <code> <text>`."""

    def __init__(self, code: int, text: str) -> None:
        super().__init__(text)
        self.code = code


UNKNOWN, BAD_ARGUMENT, UNSAFE = 1, 2, 3


class SerialPeer:
    """Answers each line with `reply(line)` at a pseudo-terminal that `link` points to.

    `reply` returns the answer, or None for silence, and raises `Refusal`. The link is made by
    `start` and removed by `stop`.
    """

    def __init__(self, link: Path, reply: Callable[[str], str | None]) -> None:
        self.link = link
        self._reply = reply
        # The far end stays open here, or the near end would fail between two clients.
        self._near, self._far = os.openpty()
        tty.setraw(self._far)
        self._wake_read, self._wake_write = os.pipe()
        self._thread = threading.Thread(target=self._run, name=link.name, daemon=True)

    @property
    def path(self) -> str:
        """The device path behind the link."""
        return os.ttyname(self._far)

    def start(self) -> None:
        """Make the link and answer from now on."""
        fresh = self.link.with_name(self.link.name + ".new")
        fresh.unlink(missing_ok=True)
        fresh.symlink_to(self.path)
        fresh.replace(self.link)
        self._thread.start()

    def stop(self) -> None:
        """Remove the link and close the terminal."""
        if self.link.is_symlink() and str(self.link.readlink()) == self.path:
            self.link.unlink()
        os.write(self._wake_write, b"x")
        self._thread.join()
        for end in (self._near, self._far, self._wake_read, self._wake_write):
            os.close(end)

    def _run(self) -> None:
        pending = b""
        while True:
            ready, _, _ = select.select([self._near, self._wake_read], [], [])
            if self._wake_read in ready:
                return
            pending += os.read(self._near, 4096)
            *lines, pending = pending.split(b"\n")
            if len(pending) > _LONGEST_LINE:
                pending = b""
            for line in lines:
                answer = self._answer(line)
                if answer is not None:
                    os.write(self._near, answer.encode() + b"\n")

    def _answer(self, line: bytes) -> str | None:
        try:
            return self._reply(line.decode("ascii").rstrip("\r"))
        except UnicodeDecodeError:
            return f"ERR {UNKNOWN} not ASCII"
        except Refusal as refusal:
            return f"ERR {refusal.code} {refusal}"


def whole(text: str, low: int, high: int, what: str) -> int:
    """`text` as a whole number from `low` to `high`; raises `Refusal`."""
    if not text.isdecimal() or not low <= int(text) <= high:
        raise Refusal(BAD_ARGUMENT, f"{what} must be a whole number {low} to {high}")
    return int(text)

"""A pseudo-terminal as a serial port that can be unplugged, and devices on it."""

from __future__ import annotations

import os
import select
import threading
import tty
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Adapter:
    """An RS-485 adapter: `echo` returns the client's bytes; `before` and `after` surround each
    reply."""

    echo: bool = False
    before: bytes = b""
    after: bytes = b""


class Terminal:
    """The near end of a pseudo-terminal; `link` points to the client's end.

    One thread receives and sends; `wake` may be called from any.
    """

    def __init__(self, link: Path) -> None:
        self.link = link
        self.adapter = Adapter()
        self._wake_read, self._wake_write = os.pipe()
        self._make()

    @property
    def path(self) -> str:
        """The device path behind the link."""
        return os.ttyname(self._far)

    def make_link(self) -> None:
        """Make `link` point to the far end."""
        fresh = self.link.with_name(self.link.name + ".new")
        fresh.unlink(missing_ok=True)
        fresh.symlink_to(self.path)
        fresh.replace(self.link)

    def receive(self, within_s: float | None = None) -> bytes | None:
        """Received bytes; empty after `within_s`; None if the peer stops."""
        ready, _, _ = select.select([self._near, self._wake_read], [], [], within_s)
        if self._wake_read in ready:
            return None
        data = os.read(self._near, 4096) if ready else b""
        if self.adapter.echo and data:
            os.write(self._near, data)
        return data

    def send(self, data: bytes) -> None:
        """Send to the far end."""
        os.write(self._near, self.adapter.before + data + self.adapter.after)

    def stops_within(self, seconds: float) -> bool:
        """Wait so long; True at once if the peer stops."""
        ready, _, _ = select.select([self._wake_read], [], [], seconds)
        return bool(ready)

    def unplug(self, seconds: float) -> None:
        """Close the far end and remove the link; after `seconds` make new ones."""
        self._remove_link()
        self._close()
        gone = self.stops_within(seconds)
        self._make()
        if not gone:
            self.make_link()

    def wake(self) -> None:
        """Make the receiving thread stop."""
        os.write(self._wake_write, b"x")

    def close(self) -> None:
        """Remove the link and close; the receiving thread has stopped."""
        self._remove_link()
        self._close()
        os.close(self._wake_read)
        os.close(self._wake_write)

    def _make(self) -> None:
        # the far end stays open, or the near end would fail between two clients
        self._near, self._far = os.openpty()
        tty.setraw(self._far)

    def _close(self) -> None:
        os.close(self._near)
        os.close(self._far)

    def _remove_link(self) -> None:
        if self.link.is_symlink() and str(self.link.readlink()) == self.path:
            self.link.unlink()


class TerminalPeer(ABC):
    """A device at a pseudo-terminal that `link` points to, on a thread of its own."""

    def __init__(self, link: Path) -> None:
        self.link = link
        self._terminal = Terminal(link)
        self._thread = threading.Thread(target=self._run, name=link.name, daemon=True)

    def start(self) -> str:
        """Make the link and serve; returns the link's path."""
        self._terminal.make_link()
        self._thread.start()
        return str(self.link)

    def stand_behind(self, adapter: Adapter) -> None:
        """Put this adapter between client and device."""
        self._terminal.adapter = adapter

    def stop(self) -> None:
        """Remove the link and close the terminal."""
        self._terminal.wake()
        self._thread.join()
        self._terminal.close()

    @abstractmethod
    def _run(self) -> None:
        """Serve until the terminal stops."""

"""A small file that another process may change, read without waiting for its disk."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from pathlib import Path
from typing import Generic, TypeVar

from stage_service.background import beside

T = TypeVar("T")
Version = tuple[int, int, int] | None
"""Inode, modification time (ns) and size of a file; None: no file."""


class PolledFile(Generic[T]):
    """The value of `read()`, called on a thread of its own whenever `path` has changed.

    `value` waits at most `wait_s` seconds for the disk, else returns the last value. The file is
    checked at most once in `every_s` seconds.
    """

    def __init__(
        self, path: Path, read: Callable[[], T], first: T, *, wait_s: float, every_s: float = 0.0
    ) -> None:
        self._path, self._read, self._wait_s, self._every_s = path, read, wait_s, every_s
        self._last: tuple[Version, T] = (None, first)
        self._polling = threading.Lock()
        self._pending: Future[T] | None = None
        self._until = self._due = self._begun = 0.0

    @property
    def value(self) -> T:
        """The newest value; raises no error of the disk."""
        return self.checked(within_s=0.0)

    def checked(self, within_s: float) -> T:
        """The value; the file is checked if its last check began more than `within_s` ago."""
        with self._polling:
            now = time.monotonic()
            due = max(self._due, self._begun + within_s)
            if (self._pending is None or self._pending.done()) and now >= due:
                self._pending, self._begun = beside(self._poll, self._path.name), now
                self._until, self._due = now + self._wait_s, now + self._every_s
            pending, left = self._pending, max(0.0, self._until - now)
        if pending is None:
            return self._last[1]
        return pending.result() if wait([pending], left).done else self._last[1]

    def changed(self) -> None:
        """Make the next reader wait for the file, which this process has just written."""
        with self._polling:
            self._pending, self._due, self._begun = None, 0.0, 0.0

    def _poll(self) -> T:
        version = version_of(self._path)
        if version != self._last[0]:
            self._last = (version, self._read())
        return self._last[1]


def version_of(path: Path) -> Version:
    """The file's version."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_ino, found.st_mtime_ns, found.st_size

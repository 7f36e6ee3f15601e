"""A small file that another process may change, for readers that must not wait for its disk."""

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
"""Inode, time of the last change (ns) and size of a file; None: there is none."""


class PolledFile(Generic[T]):
    """What `read()` returns, called again on a thread of its own once `path` has changed.

    `value` waits at most `wait_s` seconds for the disk, and returns the last value meanwhile. It
    looks at the disk once in `every_s` seconds.
    """

    def __init__(
        self, path: Path, read: Callable[[], T], first: T, *, wait_s: float, every_s: float = 0.0
    ) -> None:
        self._path, self._read, self._wait_s, self._every_s = path, read, wait_s, every_s
        self._last: tuple[Version, T] = (None, first)
        self._looking = threading.Lock()
        self._look: Future[T] | None = None
        self._until = self._due = 0.0

    @property
    def value(self) -> T:
        """The newest value; raises nothing that has to do with the disk."""
        with self._looking:
            now = time.monotonic()
            if (self._look is None or self._look.done()) and now >= self._due:
                self._look = beside(self._looked, self._path.name)
                self._until, self._due = now + self._wait_s, now + self._every_s
            look, left = self._look, max(0.0, self._until - now)
        if look is None:
            return self._last[1]
        return look.result() if wait([look], left).done else self._last[1]

    def changed(self) -> None:
        """Have the next reader wait for the file: this process has just written it."""
        with self._looking:
            self._look, self._due = None, 0.0

    def _looked(self) -> T:
        version = version_of(self._path)
        if version != self._last[0]:
            self._last = (version, self._read())
        return self._last[1]


def version_of(path: Path) -> Version:
    """What changes whenever the file does."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_ino, found.st_mtime_ns, found.st_size

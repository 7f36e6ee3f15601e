"""The captures on the disk: read in the background, the newest first."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from pathlib import Path

from reconstruction.reading import printable
from stage_service.acquisition.states import CaptureStatus, read_status
from stage_service.captures.status_index import FILES, StatusIndex

log = logging.getLogger("hairstage.captures")
PAUSE_S = 0.2


class UnknownCapture(LookupError):
    """No capture has this id."""

    def __init__(self, capture_id: str) -> None:
        super().__init__(f"there is no capture {capture_id!r}")


class Catalogue:
    """The captures in `folder` that are not being shot, by id; `index` caches the statuses of
    unchanged ones.

    The folder is listed once. Each capture is read by `begin`'s thread, or on request; an
    unreadable one is listed as damaged.
    """

    def __init__(self, folder: Path, index: Path) -> None:
        self._folder, self._index = folder, StatusIndex(index)
        self._lock = threading.Lock()  # held briefly
        self._reading = threading.Lock()  # held while a capture is read
        self._found: dict[str, CaptureStatus] = {}
        self._unread: dict[str, Path] | None = None
        self._each: Callable[[CaptureStatus], object] = lambda _: None
        self._thread: threading.Thread | None = None
        self._closed = threading.Event()

    @property
    def unread(self) -> int:
        """How many captures have not been read yet."""
        return len(self._names())

    def begin(
        self,
        each: Callable[[CaptureStatus], object],
        then: Callable[[], object],
        busy: Callable[[], bool],
        within_s: float,
    ) -> None:
        """Read all on a thread, which pauses while `busy()`; waits for it for `within_s` seconds.

        `each(status)` is called for every capture that is read, `then()` after the last one.
        """
        self._each = each
        self._names()

        def run() -> None:
            self._read_all(busy)
            if not self._closed.is_set():
                then()

        self._thread = threading.Thread(target=run, name="catalogue", daemon=True)
        self._thread.start()
        self._thread.join(within_s)

    def close(self) -> None:
        """Stop reading."""
        self._closed.set()
        if self._thread is not None:
            self._thread.join(timeout=5)

    def read(self, name: str) -> None:
        """Read a capture now, unless it was read."""
        folder = self._names().get(name)
        if folder is not None:
            self._read(folder)

    def read_all(self) -> None:
        """Read all now, unless a thread does."""
        if self._thread is None:
            self._read_all(lambda: False)

    def get(self, name: str) -> CaptureStatus:
        """The status of a capture that was read. Raises `UnknownCapture`."""
        with self._lock:
            if name not in self._found:
                raise UnknownCapture(name)
            return self._found[name]

    def list(self) -> list[CaptureStatus]:
        """All statuses that were read, in no order."""
        with self._lock:
            return list(self._found.values())

    def put(self, status: CaptureStatus) -> None:
        """List a capture that is no longer being shot."""
        with self._lock:
            self._found[status.id] = status

    def adopt(self, name: str) -> None:
        """List a capture whose folder is new here, or has changed."""
        self.put(read_status(self._folder / name))

    def take(self, name: str) -> None:
        """Take a capture off the list: it is being shot, or moved away."""
        unread = self._names()
        with self._lock:
            unread.pop(name, None)
            self._found.pop(name, None)

    def _names(self) -> dict[str, Path]:
        """The folders that have not been read, the newest first."""
        with self._lock:
            if self._unread is None:
                self._unread = {}
                for path in sorted(self._folder.iterdir(), reverse=True):
                    if printable(path.name) != path.name:
                        name = printable(str(path))
                        log.warning("%s: the folder's name is not UTF-8: skipped", name)
                    elif not path.name.startswith("."):
                        self._unread[path.name] = path
            return self._unread

    def _read_all(self, busy: Callable[[], bool]) -> None:
        for folder in list(self._names().values()):
            while busy() and not self._closed.is_set():
                self._closed.wait(PAUSE_S)
            if self._closed.is_set():
                break
            self._read(folder)
        self._index.save()

    def _read(self, folder: Path) -> None:
        unread = self._names()
        with self._reading:
            if folder.name not in unread:
                return
            known = folder.is_symlink() or any(_there(folder / f) for f in FILES)
            status = self._index.status(folder) if known else None
            with self._lock:
                del unread[folder.name]
                if status is None:  # not a capture
                    return
                self._found[folder.name] = status
        if status.outcome == "damaged":
            log.warning("%s is damaged: %s", status.path, status.error)
        self._each(status)


def _there(path: Path) -> bool:
    try:
        path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    except OSError:  # `read_status` reports it
        return True
    return True

"""Names for the workers of one root folder, held for as long as their process lives."""

from __future__ import annotations

import fcntl
from pathlib import Path
from typing import IO


class WorkerSlot:
    """A worker's name among the workers of one root: the first whose lock file is free.

    The kernel frees the lock when the process dies, however it dies. The next worker then gets the
    dead one's name, and with it the jobs that it left.
    """

    def __init__(self, root: Path) -> None:
        number = 0
        while True:
            file = (root / f"worker-{number}.lock").open("a")
            if _lock(file):
                break
            file.close()
            number += 1
        self._file = file
        self.name = f"worker-{number}"

    def release(self) -> None:
        """Give the name up before the process ends."""
        self._file.close()


def worker_is_alive(root: Path) -> bool:
    """Whether any worker of this root runs."""
    for path in root.glob("worker-*.lock"):
        with path.open("a") as file:
            if not _lock(file):
                return True
    return False


def _lock(file: IO[str]) -> bool:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True

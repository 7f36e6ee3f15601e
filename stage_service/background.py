"""Threads beside the requests."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from concurrent.futures import Future
from typing import TypeVar

T = TypeVar("T")
END_S = 5.0
"""Seconds that `close` waits for the thread."""


class Background(ABC):
    """A thread that runs `_run`; its owner starts it. `_changed` guards its data and wakes it."""

    def __init__(self, name: str) -> None:
        self._changed = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    @abstractmethod
    def _run(self) -> None:
        """Return once `_closed`."""

    def close(self) -> None:
        """End the thread, or prevent its start."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        if self._thread.is_alive():
            self._thread.join(END_S)


def beside(work: Callable[[], T], name: str) -> Future[T]:
    """The future result of `work`, on a thread of its own if one is available."""
    found: Future[T] = Future()

    def run() -> None:
        try:
            found.set_result(work())
        except BaseException as error:
            found.set_exception(error)

    try:
        threading.Thread(target=run, name=name, daemon=True).start()
    except RuntimeError:
        run()
    return found

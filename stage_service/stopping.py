"""The end of a process: parallel steps, each with a time limit, and a limit for the whole.

A job database, a disk, a device or native code may hang; none of these may keep a process from
ending.
"""

from __future__ import annotations

import logging
import os
import signal
import threading
import time
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial

from stage_service.background import beside

log = logging.getLogger("hairstage.stop")
STOP_S = 10.0
"""Longest time from the signal to the end of the process, in seconds; `TimeoutStopSec` of the units
in `deploy/systemd` and `stop_grace_period` of the containers are longer."""
LAST_S = 2.0
"""Seconds before that at which a process that hangs logs what is unfinished and exits; if that
hangs, too, the kernel ends it (SIGALRM)."""
LEFT = 1
"""Exit status of a process with unfinished steps."""


class NotEnded(RuntimeError):
    """A step has not ended in time."""


@dataclass(frozen=True)
class Step:
    """A step that has to end within `within_s` seconds; its `work` may raise `NotEnded`."""

    name: str
    work: Callable[[], object]
    within_s: float


def end_all(steps: Iterable[Step], left: list[str]) -> None:
    """Start every step, in this order, and wait for each until its limit. `left` has the names of
    those that have not ended or failed, which are logged."""
    began, under_way = time.monotonic(), []
    for step in steps:
        left.append(step.name)
        over = beside(step.work, step.name)
        over.add_done_callback(partial(_ended, left, step.name))
        under_way.append((step, over))
    for step, over in under_way:
        try:
            over.result(max(0.0, began + step.within_s - time.monotonic()))
        except Exception as error:
            if not over.done():
                log.error("%s: not ended within %g s", step.name, step.within_s)
            else:
                known = isinstance(error, NotEnded)
                log.error("%s: %s", step.name, error, exc_info=None if known else error)


def _ended(left: list[str], name: str, over: Future[object]) -> None:
    if over.exception() is None:
        left.remove(name)


class Ending:
    """Ends this process at most `STOP_S` seconds after construction, or earlier by `by`.

    `left` has the names of unfinished steps: with any of them the exit status is `LEFT`. `doing()`
    returns other work under way, for the log.
    """

    def __init__(self, left: list[str], doing: Callable[[], str] = str) -> None:
        self.left, self._doing = left, doing
        self._began = time.monotonic()
        self._sooner = threading.Condition()
        self._at = self._began + STOP_S - LAST_S
        signal.setitimer(signal.ITIMER_REAL, STOP_S)
        threading.Thread(target=self._watch, name="end of the process", daemon=True).start()

    def by(self, seconds: float) -> None:
        """End it at most `seconds` from now."""
        with self._sooner:
            self._at = min(self._at, time.monotonic() + seconds)
            self._sooner.notify_all()

    def now(self) -> None:
        """End it, and log unfinished steps."""
        doing = self._doing()
        if self.left or doing:
            what = "; ".join([*self.left, *([doing] if doing else [])])
            seconds = time.monotonic() - self._began
            log.error("ended %.1f s after it was to stop; not ended: %s", seconds, what)
        logging.shutdown()
        os._exit(LEFT if self.left else 0)

    def _watch(self) -> None:
        with self._sooner:
            while (wait := self._at - time.monotonic()) > 0:
                self._sooner.wait(wait)
        self.now()

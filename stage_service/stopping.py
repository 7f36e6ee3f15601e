"""The end of a process: steps beside each other, each with its own time, and a limit for the whole.

What a process waits for may hang for ever: a job database that was frozen, a disk that is gone, a
device, native code. None of these may keep it from ending.
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
"""Seconds from the signal to the end of the process, whatever hangs; `TimeoutStopSec` of the units
in `deploy/systemd`, and `stop_grace_period` of the containers, are longer."""
LAST_S = 2.0
"""So much earlier a process that hangs says what it leaves and ends by itself; should even that
hang, the kernel ends it (SIGALRM)."""
LEFT = 1
"""Exit status of a process that has left something unfinished."""


class NotEnded(RuntimeError):
    """What was to end goes on, and is not waited for any longer."""


@dataclass(frozen=True)
class Step:
    """Something to end, named as the log has it, within `within_s` seconds; `NotEnded` says why it
    could not be ended."""

    name: str
    work: Callable[[], object]
    within_s: float


def end_all(steps: Iterable[Step], left: list[str]) -> None:
    """Begin every step, in this order, and wait for each as long as it has from now. `left` has the
    names of those that have not ended yet, or failed; the log says why, and the others go on."""
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
    """Ends this process at most `STOP_S` seconds after this is made, or when `by` said so.

    `left` has the names of what has not ended yet: with any of them the exit status is `LEFT`.
    `doing()` says what else is under way, for the log.
    """

    def __init__(self, left: list[str], doing: Callable[[], str] = str) -> None:
        self.left, self._doing = left, doing
        self._began = time.monotonic()
        self._sooner = threading.Condition()
        self._at = self._began + STOP_S - LAST_S
        signal.setitimer(signal.ITIMER_REAL, STOP_S)
        threading.Thread(target=self._watch, name="end of the process", daemon=True).start()

    def by(self, seconds: float) -> None:
        """End it so many seconds from now, or earlier where that was to be so."""
        with self._sooner:
            self._at = min(self._at, time.monotonic() + seconds)
            self._sooner.notify_all()

    def now(self) -> None:
        """End it, with a line in the log where anything is left."""
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

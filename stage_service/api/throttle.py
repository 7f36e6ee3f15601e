"""Processor time for callers without the scope `steer` while a capture runs.

Python runs one thread at a time, so requests slow the capture's threads. During a capture, work for
callers without `steer` is serialised, with a rest after each piece that limits it to `SHARE`.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

SHARE = 0.03
"""Share of the time for all callers without `steer`. Together with events and refusals they slow a
capture by less than 5 %."""
OVERHEAD_S = 1.5e-3
"""Seconds of the event loop per request, added to its handler's time."""
MOST_COST_S = 0.5
"""Longer times are counted as this: they are waits for a disk or a database."""
WAIT_S = 10.0
"""A request without a turn within this time is refused."""
LOOK_S = 0.25
"""Seconds between checks during a rest whether the capture has ended."""


NO_TURN = (
    f"a capture is running: until its end all tokens without the scope 'steer' share {SHARE:.0%} "
    "of "
    f"the processor, and no turn was free within {WAIT_S:g} s: try again later, or send fewer "
    "requests"
)


class Throttled(RuntimeError):
    """A capture is running, and no turn was free in time."""

    status = 503

    def __init__(self, why: str = NO_TURN) -> None:
        super().__init__(why)


class Turn:
    """Permission for a piece of work; `end` may be called more than once."""

    def __init__(self, ended: Callable[[float], None] | None = None) -> None:
        self._ended, self._began = ended, time.monotonic()

    def end(self) -> None:
        """End the work; its time determines the rest."""
        if self._ended is not None:
            self._ended(time.monotonic() - self._began)
            self._ended = None


class Throttle:
    """Grants turns, at once while no capture runs. For one event loop only."""

    def __init__(self, shooting: Callable[[], bool]) -> None:
        self._shooting = shooting
        self._lock = asyncio.Lock()
        self._rest_until = 0.0

    async def turn(self, *, patient: bool = False) -> Turn:
        """Wait for a turn. Raises `Throttled` after `WAIT_S`, unless `patient`."""
        if not self._shooting():
            return Turn()
        try:
            async with asyncio.timeout(None if patient else WAIT_S):
                await self._lock.acquire()
                try:
                    while self._shooting() and (rest := self._rest_until - time.monotonic()) > 0:
                        await asyncio.sleep(min(rest, LOOK_S))
                except BaseException:
                    self._lock.release()
                    raise
        except TimeoutError:
            raise Throttled from None
        return Turn(self._end)

    def _end(self, took: float) -> None:
        self._rest_until = time.monotonic() + (OVERHEAD_S + min(took, MOST_COST_S)) / SHARE
        self._lock.release()

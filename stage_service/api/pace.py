"""What callers who may not steer get of the processor while a capture is shot.

Python runs one thread at a time: what the service computes for somebody is taken from the capture's
threads. While one is shot, work for callers without `steer` is done one piece after the other, with
a rest after each that keeps all of them to a share of the time.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

SHARE = 0.03
"""Of the time, for all callers without `steer` together. With the events' share (`event_stream`),
and what is refused, it is under the 5 % that they may slow a capture by."""
OVERHEAD_S = 1.5e-3
"""Of the event loop for the headers and the answer of a request, beside its handler's time."""
MOST_COST_S = 0.5
"""A piece that takes longer has waited for a disk or a database, not for the processor."""
WAIT_S = 10.0
"""Whoever has had no turn within this time is refused."""
LOOK_S = 0.25
"""How often a rest looks whether the capture is over."""


NO_TURN = (
    f"a capture is being shot: until it ends all tokens without the scope 'steer' get {SHARE:.0%} "
    f"of the processor together, and there was no turn within {WAIT_S:g} s; try again later, or "
    "send fewer requests"
)


class Paced(RuntimeError):
    """A capture is being shot, and it was nobody's turn in time."""

    status = 503

    def __init__(self, why: str = NO_TURN) -> None:
        super().__init__(why)


class Turn:
    """A piece of work that may be done now; to be ended, once or more often."""

    def __init__(self, ended: Callable[[float], None] | None = None) -> None:
        self._ended, self._began = ended, time.monotonic()

    def end(self) -> None:
        """It is done; what it took is rested for."""
        if self._ended is not None:
            self._ended(time.monotonic() - self._began)
            self._ended = None


class Pace:
    """Gives turns: at once while nothing is shot. For one event loop, and no other thread."""

    def __init__(self, shooting: Callable[[], bool]) -> None:
        self._shooting = shooting
        self._one = asyncio.Lock()
        self._rested = 0.0

    async def turn(self, *, patient: bool = False) -> Turn:
        """Wait for a turn. Raises `Paced` where there is none within `WAIT_S`, unless `patient`."""
        if not self._shooting():
            return Turn()
        try:
            async with asyncio.timeout(None if patient else WAIT_S):
                await self._one.acquire()
                try:
                    while self._shooting() and (rest := self._rested - time.monotonic()) > 0:
                        await asyncio.sleep(min(rest, LOOK_S))
                except BaseException:
                    self._one.release()
                    raise
        except TimeoutError:
            raise Paced from None
        return Turn(self._end)

    def _end(self, took: float) -> None:
        self._rested = time.monotonic() + (OVERHEAD_S + min(took, MOST_COST_S)) / SHARE
        self._one.release()

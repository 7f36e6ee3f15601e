"""Processor time of requests while a capture runs.

Python runs one thread at a time, so requests slow the capture's threads. During a capture, the work
for all callers without the scope `steer` is serialised, with a rest after each piece that limits it
to `SHARE`. The work for a token with `steer` is limited to `STEERING_SHARE`, beyond the `CREDIT_S`
that a page needs.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

from stage_service.api.places import Owner

SHARE, STEERING_SHARE = 0.03, 0.06
"""Share of the time for all callers without `steer`, and for each token with it. Together with
events and refusals the former slow a capture by less than 5 %."""
CREDIT_S, STEERING_AT_ONCE = 2.0, 2
"""Seconds of work for a token with `steer` without rests, regained while it requests nothing, and
how many of its requests are at work at a time. Opening the console takes 0.1 to 0.4 s."""
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
    f"of the processor, and a token with it has {STEERING_SHARE:.0%}. No turn was free within "
    f"{WAIT_S:g} s: try again later, or send fewer requests"
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


class _Lane:
    """Callers that share the processor: a token that `steers`, or all others."""

    def __init__(self, steers: bool) -> None:
        self._steers, self.rest_until = steers, 0.0
        self.at_once = asyncio.Semaphore(STEERING_AT_ONCE if steers else 1)

    def end(self, took: float) -> None:
        """End a piece of work of so many seconds."""
        share, credit_s = (STEERING_SHARE, CREDIT_S) if self._steers else (SHARE, 0.0)
        earliest = time.monotonic() - credit_s / share
        cost = OVERHEAD_S + min(took, MOST_COST_S)
        self.rest_until = max(self.rest_until, earliest) + cost / share
        self.at_once.release()


class Throttle:
    """Grants turns, at once while no capture runs. For one event loop only."""

    def __init__(self, shooting: Callable[[], bool]) -> None:
        self._shooting = shooting
        self._others, self._steering = _Lane(steers=False), dict[Owner, _Lane]()

    async def turn(self, owner: Owner, *, patient: bool = False) -> Turn:
        """Wait for a turn. Raises `Throttled` after `WAIT_S`, unless `patient`."""
        if not self._shooting():
            return Turn()
        lane = self._others
        if owner.steers:
            lane = self._steering.setdefault(owner, _Lane(steers=True))
        try:
            async with asyncio.timeout(None if patient else WAIT_S):
                await lane.at_once.acquire()
                try:
                    while self._shooting() and (rest := lane.rest_until - time.monotonic()) > 0:
                        await asyncio.sleep(min(rest, LOOK_S))
                except BaseException:
                    lane.at_once.release()
                    raise
        except TimeoutError:
            raise Throttled from None
        return Turn(lane.end)

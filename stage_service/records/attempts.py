"""Wrong logins, and how long whoever made them has to wait for the next."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

FREE = 5
"""Wrong tokens that cost no wait: whoever pastes the wrong line tries again at once."""
FIRST_S, LONGEST_S = 1.0, 30.0
"""The wait after one more, doubled by each that follows, and its end: whoever shares an address
with a program that guesses gets in soon after it has ended. A token has 256 random bits; the wait
is there for tokens that people write themselves, and for the machine's sake."""
FORGET_S = 900.0
"""After so long without a wrong one all is forgotten."""
MOST_KEPT = 1000
"""Addresses; one more forgets the one that has waited longest."""


class TooManyLogins(PermissionError):
    """Too many wrong logins came from there; `retry_after` is the wait in seconds."""

    def __init__(self, origin: str, seconds: float) -> None:
        self.retry_after = max(1, round(seconds + 0.5))
        super().__init__(
            f"too many wrong logins from {origin}: log in again in {self.retry_after} s. This "
            "login's token was not looked at"
        )


@dataclass
class _Wrong:
    count: int = 0
    last: float = 0.0
    until: float = 0.0


class Attempts:
    """Wrong logins by where they came from. None waits here: one that is too early is refused."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._wrong: OrderedDict[str, _Wrong] = OrderedDict()

    def check(self, origin: str) -> None:
        """Raise `TooManyLogins` where `origin` has to wait."""
        with self._lock:
            wrong = self._wrong.get(origin)
            left = 0.0 if wrong is None else wrong.until - self._clock()
        if left > 0:
            raise TooManyLogins(origin, left)

    def failed(self, origin: str) -> None:
        """A wrong login came from `origin`. A right one changes nothing: who has a token could
        else guess another between two of their own."""
        now = self._clock()
        with self._lock:
            wrong = self._wrong.setdefault(origin, _Wrong())
            self._wrong.move_to_end(origin)
            if now - wrong.last > FORGET_S:
                wrong.count = 0
            wrong.count, wrong.last = wrong.count + 1, now
            if wrong.count >= FREE:
                wait_s = FIRST_S * 2.0 ** min(wrong.count - FREE, 10)
                wrong.until = now + min(wait_s, LONGEST_S)
            while len(self._wrong) > MOST_KEPT:
                self._wrong.popitem(last=False)

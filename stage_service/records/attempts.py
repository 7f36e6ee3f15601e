"""Limits the rate of wrong logins by address."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

FREE = 5
"""Wrong tokens without a wait, as for a line pasted by mistake."""
FIRST_S, LONGEST_S = 1.0, 30.0
"""The first wait, doubled by each further wrong token, and the longest. A generated token has 256
random bits; the wait protects tokens that people choose, and the machine."""
FORGET_S = 900.0
"""Seconds without a wrong token after which the count is reset."""
MOST_KEPT = 1000
"""Addresses that are counted; the oldest is dropped first."""


class TooManyLogins(PermissionError):
    """Too many wrong logins from one address; `retry_after` is the wait in seconds."""

    def __init__(self, origin: str, seconds: float) -> None:
        self.retry_after = max(1, round(seconds + 0.5))
        super().__init__(
            f"too many wrong logins from {origin}: log in again in {self.retry_after} s. This "
            "login's token was not checked"
        )


@dataclass
class _Wrong:
    count: int = 0
    last: float = 0.0
    until: float = 0.0


class Attempts:
    """Counts wrong logins by address and refuses early ones."""

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
        """Count a wrong login. A right one does not reset the count, or the owner of a token could
        guess others between two logins of their own."""
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

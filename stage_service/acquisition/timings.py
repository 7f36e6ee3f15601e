"""Seconds of a capture by cause."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from statistics import median


class Timings:
    """Seconds by cause, and the rest of each step: the service's own work.

    One thread uses it. Causes must not be nested.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._own: list[float] = []

    @contextmanager
    def on(self, cause: str) -> Iterator[None]:
        """Count the block's time to `cause`."""
        began = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[cause] += time.perf_counter() - began

    @contextmanager
    def step(self) -> Iterator[None]:
        """Time a step; the part without a cause counts as "service"."""
        began, before = time.perf_counter(), sum(self.seconds.values())
        yield
        explained = sum(self.seconds.values()) - before
        self._own.append(time.perf_counter() - began - explained)
        self.seconds["service"] += self._own[-1]

    @property
    def own_median_s(self) -> float | None:
        """The service's own seconds per step, at the median; None before the first step."""
        return median(self._own) if self._own else None

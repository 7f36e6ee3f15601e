"""The lamps of the light bank: what was commanded, and the watchdog over it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

FULL = 65535
ALL_ON = 65535
COILS_WERE_WRITTEN = 65534
WATCHDOG_MS = (100, 60_000)


class Lamps:
    """On/off and level of `count` lamps. Safe to call from several threads.

    The watchdog needs no thread of its own: whoever looks at the lamps first puts them off where
    the deadline has passed, so nobody ever sees them lit after it. `clock` is monotonic seconds.
    """

    def __init__(self, count: int, clock: Callable[[], float] = time.monotonic) -> None:
        if not 1 <= count <= 1000:
            raise ValueError(f"the light bank's addresses hold 1 to 1000 lamps, got {count}")
        self.count = count
        self._clock = clock
        self._lock = threading.RLock()
        self._on = np.zeros(count, bool)
        self._level = np.full(count, FULL, np.int64)
        self._selector = 0
        self._heartbeat = 0
        self._watchdog_ms = 2000
        self._fed = clock()
        self._tripped = False
        self._cut: Callable[[], tuple[bool, bool]] = lambda: (False, False)

    def cut_by(self, safety: Callable[[], tuple[bool, bool]]) -> None:
        """Let `safety()` say whether the interlock is open and the emergency stop pressed.

        Either cuts the lamps' supply: they go off and stay off until they are commanded again.
        """
        self._cut = safety

    def power(self) -> NDArray[np.float64]:
        """Share of full intensity `(count,)` that each lamp gives right now, 0 to 1."""
        with self._lock:
            self._look()
            return np.where(self._on, self._level / FULL, 0.0)

    def status(self) -> tuple[int, int]:
        """The status bits and the number of lit lamps, as the input registers give them."""
        with self._lock:
            self._look()
            interlock, estop = self._cut()
            lit = int(np.count_nonzero(self._on & (self._level > 0)))
            bits = self._tripped | interlock << 1 | estop << 2 | (lit > 0) << 3
            return int(bits), lit

    def coils(self) -> list[bool]:
        """Which lamps are on."""
        with self._lock:
            self._look()
            return [bool(on) for on in self._on]

    def levels(self) -> list[int]:
        """Levels of the lamps, 0 … 65535."""
        with self._lock:
            return [int(level) for level in self._level]

    def control(self) -> tuple[int, int, int]:
        """Selector, last heartbeat and watchdog time in ms, as they read back."""
        with self._lock:
            return self._selector, self._heartbeat, self._watchdog_ms

    def switch(self, first: int, on: Sequence[bool]) -> None:
        """Put lamps on or off from lamp `first`."""
        with self._lock:
            wanted = self._on.copy()
            wanted[first : first + len(on)] = on
            self._set(wanted)
            self._selector = COILS_WERE_WRITTEN

    def dim(self, first: int, levels: Sequence[int]) -> None:
        """Set levels from lamp `first`."""
        with self._lock:
            self._level[first : first + len(levels)] = levels

    def select(self, command: int) -> bool:
        """The selector's command; False, and nothing happens, where there is no such lamp."""
        with self._lock:
            if command == ALL_ON:
                self._set(np.ones(self.count, bool))
            elif command <= self.count:
                self._set(np.arange(self.count) == command - 1)
            else:
                return False
            self._selector = command
            return True

    def beat(self, value: int) -> None:
        """A heartbeat: feeds the watchdog and clears its bit; lamps that went off stay off."""
        with self._lock:
            self._look()
            self._heartbeat = value
            self._fed = self._clock()
            self._tripped = False

    def watch(self, milliseconds: int) -> bool:
        """Set the watchdog time; False, and nothing happens, when it is out of range."""
        with self._lock:
            if not WATCHDOG_MS[0] <= milliseconds <= WATCHDOG_MS[1]:
                return False
            self._look()
            self._watchdog_ms = milliseconds
            return True

    def _set(self, wanted: NDArray[np.bool_]) -> None:
        self._look()
        if any(self._cut()):
            wanted = np.zeros(self.count, bool)
        if wanted.any() and not self._on.any():
            # The time without a heartbeat counts only while a lamp is lit.
            self._fed = max(self._fed, self._clock())
        self._on = wanted

    def _look(self) -> None:
        if not self._on.any():
            return
        if self._clock() - self._fed > self._watchdog_ms / 1000:
            self._on = np.zeros(self.count, bool)
            self._tripped = True
        if any(self._cut()):
            self._on = np.zeros(self.count, bool)

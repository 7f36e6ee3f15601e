"""The lamps of the light bank: commanded state, sequence, and watchdog."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence

import numpy as np

from reconstruction.arrays import Array, Bools

FULL = 65535
ALL_ON = 65535
COILS_WERE_WRITTEN = 65534
WATCHDOG_MS = (100, 60_000)
ENTRIES = 4096
OWNER_WORDS = 17


class NotNow(Exception):
    """The command is refused while a sequence is armed."""


class Lamps:
    """On/off and level of `count` lamps, and their sequence. Safe to call from several threads.

    While a sequence is armed its entries are lit by `gate`, and the watchdog also runs in the dark,
    so that short flashes do not keep it from tripping. Watchdog, interlock and emergency stop
    disarm the sequence.

    The watchdog has no thread: each access puts the lamps off first if the deadline has passed.
    `clock` is monotonic seconds.
    """

    def __init__(self, count: int, clock: Callable[[], float] = time.monotonic) -> None:
        if not 1 <= count <= 1000:
            raise ValueError(f"expected 1 to 1000 lamps, got {count}")
        self.count = count
        self._clock = clock
        self._lock = threading.RLock()
        self._on = np.zeros(count, bool)
        self._level = np.full(count, FULL, np.int64)
        self._selector, self._heartbeat, self._watchdog_ms = 0, 0, 2000
        self._dead_man = True
        self._fed = clock()
        self._tripped = False
        self._table = np.zeros((ENTRIES, 2), np.uint16)
        self._armed = self._position = 0
        self._gate = False
        self._owner = [0] * OWNER_WORDS
        self._stuck = np.zeros(count, bool)
        self._cut: Callable[[], tuple[bool, bool]] = lambda: (False, False)

    def cut_by(self, safety: Callable[[], tuple[bool, bool]]) -> None:
        """Set `safety()`: whether the interlock is open, and the emergency stop pressed.

        Either cuts the lamps' supply: they stay off until they are commanded again.
        """
        self._cut = safety

    def without_dead_man(self) -> None:
        """Remove the watchdog, as on DMX: lamps stay lit if the host stops."""
        self._dead_man = False

    def power(self) -> Array:
        """Present share of full intensity of each lamp `(L,)`, 0 to 1."""
        with self._lock:
            self._look()
            return np.where(self._on | self._stuck, self._level / FULL, 0.0)

    def status(self) -> tuple[int, int]:
        """The status bits and the number of lit lamps, as the input registers give them."""
        with self._lock:
            self._look()
            interlock, estop = self._cut()
            lit = int(np.count_nonzero((self._on | self._stuck) & (self._level > 0)))
            bits = self._tripped | interlock << 1 | estop << 2 | (lit > 0) << 3
            return int(bits | (self._armed > 0) << 4), lit

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

    def switch(self, first: int, on: Sequence[int]) -> None:
        """Put lamps on or off from lamp `first`; raises `NotNow`."""
        with self._lock:
            self._refuse_while_armed()
            wanted = self._on.copy()
            wanted[first : first + len(on)] = on
            self._set(wanted)
            self._selector = COILS_WERE_WRITTEN

    def dim(self, first: int, levels: Sequence[int]) -> None:
        """Set levels from lamp `first`."""
        with self._lock:
            self._level[first : first + len(levels)] = levels

    def show(self, levels: Sequence[int]) -> None:
        """Level of every lamp at once; 0 is off."""
        with self._lock:
            self._level[:] = levels
            self._set(self._level > 0)

    def select(self, command: int) -> bool:
        """Execute the selector's command; False without effect if there is no such lamp.

        Raises `NotNow`.
        """
        with self._lock:
            self._refuse_while_armed()
            if command > self.count and command != ALL_ON:
                return False
            self._set(self._chosen(command))
            self._selector = command
            return True

    def load(self, first: int, words: Sequence[int]) -> None:
        """Write words of the sequence table from word `first`: per entry lamp and level."""
        with self._lock:
            self._table.reshape(-1)[first : first + len(words)] = words

    def table(self) -> list[int]:
        """The words of the sequence table."""
        with self._lock:
            return [int(word) for word in self._table.reshape(-1)]

    def arm(self, entries: int) -> bool:
        """All lamps off; arm that many entries of the table, or disarm with 0.

        False without effect if the table has fewer, or an entry names an unknown lamp.
        """
        with self._lock:
            what = self._table[:entries, 0]
            if entries > ENTRIES or np.any((what > self.count) & (what != ALL_ON)):
                return False
            self._set(np.zeros(self.count, bool))
            self._selector = 0
            self._armed = entries
            if entries:
                self._position, self._fed = 0, self._clock()
            return True

    def sequence(self) -> tuple[int, int]:
        """Number of armed entries, and of gate closings since then."""
        with self._lock:
            self._look()
            return self._armed, self._position

    def gate(self, is_open: bool) -> None:
        """The wire from the trigger box: entry k is lit while it is open, then k + 1 is next."""
        with self._lock:
            self._look()
            closes = self._gate and not is_open
            self._gate = is_open
            if not self._armed:
                return
            if closes:
                self._position += 1
                self._set(np.zeros(self.count, bool))
            elif is_open and self._position < self._armed:
                what, level = (int(word) for word in self._table[self._position])
                chosen = self._chosen(what)
                self._level[chosen] = level
                self._set(chosen)

    def stick(self) -> None:
        """A fault: lamps that are lit now stay lit."""
        with self._lock:
            self._look()
            self._stuck |= self._on

    def beat(self, value: int) -> None:
        """A heartbeat: feeds the watchdog and clears its bit; lamps that it put off stay off."""
        with self._lock:
            self._look()
            self._heartbeat = value
            self._fed = self._clock()
            self._tripped = False

    def owner(self) -> list[int]:
        """Number and name of the bank's owner."""
        with self._lock:
            return list(self._owner)

    def own(self, first: int, words: Sequence[int]) -> None:
        """Write the owner's number and name from word `first`; raises `NotNow` if another number is
        set. A new number clears the name."""
        with self._lock:
            if first == 0 and words[0] != self._owner[0]:
                if words[0] and self._owner[0]:
                    raise NotNow
                self._owner = [0] * OWNER_WORDS
            self._owner[first : first + len(words)] = words

    def watch(self, milliseconds: int) -> bool:
        """Set the watchdog time; False without effect if it is out of range."""
        with self._lock:
            if not WATCHDOG_MS[0] <= milliseconds <= WATCHDOG_MS[1]:
                return False
            self._look()
            self._watchdog_ms = milliseconds
            return True

    def _refuse_while_armed(self) -> None:
        self._look()
        if self._armed:
            raise NotNow

    def _chosen(self, command: int) -> Bools:
        return (np.arange(self.count) == command - 1) | (command == ALL_ON)

    def _set(self, wanted: Bools) -> None:
        self._look()
        if any(self._cut()):
            wanted = np.zeros(self.count, bool)
        if wanted.any() and not self._on.any() and not self._armed:
            # the time without a heartbeat counts only while a lamp is lit
            self._fed = max(self._fed, self._clock())
        self._on = wanted

    def _look(self) -> None:
        if not self._on.any() and not self._armed:
            return
        late = self._dead_man and self._clock() - self._fed > self._watchdog_ms / 1000
        self._tripped |= late
        if late or any(self._cut()):
            self._on = np.zeros(self.count, bool)
            self._armed = 0

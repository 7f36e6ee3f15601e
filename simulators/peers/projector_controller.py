"""The projector controller's serial protocol (docs/reference/wire.md) and state."""

from __future__ import annotations

import binascii
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from reconstruction import Projector
from simulators.peers.serial_peer import BAD_ARGUMENT, NOT_NOW, UNKNOWN, WATCHDOG_MS, Refusal, whole

FULL = 65535
ENTRIES = 4096
_MOST_PATTERNS = 1_000_000


@dataclass(frozen=True)
class Show:
    """The projectors' state: dark (level 0), all rows of all, or one row of one."""

    level: int = 0
    projector: str | None = None
    row: int = 0

    @property
    def power(self) -> float:
        """Share of full intensity, 0 to 1."""
        return self.level / FULL

    @property
    def everything(self) -> bool:
        """Whether all projectors show all rows: a tracking exposure."""
        return self.projector is None and self.level > 0


@dataclass(frozen=True)
class Entry:
    """`count` patterns from `first` on, `step` rows apart; `text` is for the checksum."""

    first: Show
    step: int
    count: int
    text: str

    def pattern(self, index: int) -> Show:
        """Pattern `index` of this entry."""
        return Show(self.first.level, self.first.projector, self.first.row + index * self.step)


DARK = (Show(), "OFF")


class SimulatedProjectorController:
    """Executes request lines of a `SerialPeer`. Safe to call from several threads.

    The watchdog has no thread: each access puts the projectors dark first if the deadline has
    passed. `clock` is monotonic seconds; `blank()` is whether a fault suppresses patterns.
    """

    def __init__(
        self,
        projectors: Sequence[Projector],
        blank: Callable[[], bool] = lambda: False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._rows = {p.name: p.height for p in projectors}
        self._blank = blank
        self._clock = clock
        self._lock = threading.RLock()
        self._shown = DARK
        self._watchdog = 2.0
        self._fed = clock()
        self._entries: list[Entry] = []
        self._expected = 0
        self._patterns: list[Show] = []
        self._state = "idle"
        self._position = 0
        self._gate = False

    @property
    def show(self) -> Show:
        """The present state."""
        with self._lock:
            self._look()
            return self._shown[0]

    @property
    def trigger_out(self) -> bool:
        """Whether a pattern of the sequence is up."""
        with self._lock:
            self._look()
            return self._state == "armed" and self._shown is not DARK

    def gate(self, is_open: bool) -> None:
        """The wire from the trigger box: pattern k is up while it is open, then k + 1 is next."""
        with self._lock:
            self._look()
            closes = self._gate and not is_open
            self._gate = is_open
            if self._state != "armed":
                return
            if closes:
                self._position += 1
            up = is_open and self._position < len(self._patterns) and not self._blank()
            self._shown = _described(self._patterns[self._position]) if up else DARK

    def reply(self, line: str) -> str:
        """The reply to one request; raises `Refusal`."""
        with self._lock:
            self._look()
            reply = self._execute(line.split(" "))
            self._fed = self._clock()
            return reply

    def _execute(self, words: list[str]) -> str:
        match words:
            case ["ID?"]:
                return f"HAIRSTAGE-PROJECTORS 2 {ENTRIES} {','.join(self._rows)}"
            case ["SHOW?"]:
                return f"SHOW {self._shown[1]}"
            case ["OFF"]:
                return self._leave(DARK)
            case ["ON", _] | ["LINE", _, _, _]:
                return self._leave(_described(self._what(words)))
            case ["WATCHDOG", time_ms]:
                self._watchdog = whole(time_ms, *WATCHDOG_MS, "watchdog time") / 1000
                return f"OK WATCHDOG {int(time_ms)}"
            case ["SEQ", count]:
                self._expected = whole(count, 1, ENTRIES, "entries")
                self._entries, self._position = [], 0
                self._leave(DARK)
                return f"OK SEQ {self._expected}"
            case ["ENTRY", index, *what]:
                return self._entry(index, what)
            case ["ARM"]:
                return self._arm()
            case ["SEQ?"]:
                return f"SEQ {self._state} {self._position}"
        raise Refusal(UNKNOWN, "unknown command")

    def _what(self, words: list[str]) -> Show:
        """`ON <level>` or `LINE <name> <row> <level>`."""
        level = whole(words[-1], 0, FULL, "level")
        if words[0] == "ON":
            return Show(level)
        name = words[1]
        if name not in self._rows:
            raise Refusal(BAD_ARGUMENT, f"unknown projector {name}")
        return Show(level, name, whole(words[2], 0, self._rows[name] - 1, "row"))

    def _entry(self, index: str, words: list[str]) -> str:
        if len(self._entries) >= self._expected or self._state == "armed":
            raise Refusal(NOT_NOW, "no entry is expected")
        due = len(self._entries)
        whole(index, due, due, "entry")
        match words:
            case ["ON", _]:
                entry = Entry(self._what(words), 0, 1, " ".join(words))
            case ["LINE", name, first, step, count, level]:
                show = self._what(["LINE", name, first, level])
                most = self._rows[name]
                size = whole(step.removeprefix("-"), 0, most, "step")
                signed = -size if step.startswith("-") else size
                times = whole(count, 1, _MOST_PATTERNS, "count")
                whole(str(show.row + (times - 1) * signed), 0, most - 1, "last row")
                text = f"LINE {name} {show.row} {signed} {times} {show.level}"
                entry = Entry(show, signed, times, text)
            case _:
                raise Refusal(UNKNOWN, "unknown command")
        self._entries.append(entry)
        return f"OK ENTRY {due}"

    def _arm(self) -> str:
        if not self._expected or len(self._entries) < self._expected:
            raise Refusal(NOT_NOW, f"{len(self._entries)} of {self._expected} entries are there")
        patterns = [e.pattern(i) for e in self._entries for i in range(e.count)]
        self._patterns, self._position = patterns, 0
        self._state, self._shown = "armed", DARK
        crc = binascii.crc32("".join(f"{e.text}\n" for e in self._entries).encode())
        return f"OK ARM {len(patterns)} {crc:08x}"

    def _leave(self, shown: tuple[Show, str]) -> str:
        """Show it and disarm the sequence."""
        self._state, self._shown = "idle", shown
        return f"OK {shown[1]}"

    def _look(self) -> None:
        if self._state != "armed" and self._shown is DARK:
            return
        if self._clock() - self._fed > self._watchdog:
            self._state, self._shown = "watchdog", DARK


def _described(show: Show) -> tuple[Show, str]:
    """A state with its protocol text."""
    if show.projector is None:
        return show, f"ON {show.level}"
    return show, f"LINE {show.projector} {show.row} {show.level}"

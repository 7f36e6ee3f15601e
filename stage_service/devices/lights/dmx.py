"""Lamps on DMX channels, whatever carries them."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence

from stage_service.device_config import DmxLightsConfig
from stage_service.devices.lights import limits
from stage_service.devices.lights.interface import LightCapabilities, LightStatus, Lit

CHANNELS = 512
FRAME_S = 0.023
"""A frame of 512 channels at full speed (ANSI E1.11)."""


class DmxBank(ABC):
    """Implements `LightBank` without read-back, dead-man and table; see there for the contract.

    A lamp has `channels` channels at one level, all in one universe. Levels are rounded to n / 255;
    a level above 0 that would become 0 is an error.
    """

    capabilities = LightCapabilities(reads_back=False, dead_man=False, table=0)

    def __init__(self, name: str, config: DmxLightsConfig, lamps: int) -> None:
        self.name = name
        self.count = lamps
        self._first, self._width = config.first_channel - 1, config.channels
        self.universes = self.place(lamps - 1)[0] + 1
        self._steps = config.level_steps()
        self._level = self._steps
        self._on: dict[int, int] = {}  # levels of the lamps that are on, n / `_steps`
        self._lock = threading.RLock()

    def place(self, lamp: int) -> tuple[int, int]:
        """A lamp's universe and the first of its channels, both from 0."""
        in_first = (CHANNELS - self._first) // self._width
        if lamp < in_first:
            return 0, self._first + lamp * self._width
        universe, rest = divmod(lamp - in_first, CHANNELS // self._width)
        return universe + 1, rest * self._width

    def select(self, lamp: int) -> None:
        if not 0 <= lamp < self.count:
            raise ValueError(f"{self.name}: lamps are 0 to {self.count - 1}, got {lamp}")
        self._show([lamp], f"putting lamp {lamp} on")

    def all_on(self) -> None:
        self._show(range(self.count), "putting all lamps on")

    def show(self, levels: Sequence[float]) -> None:
        doing = "putting lamps on at levels of their own"
        words = limits.level_words(self.name, doing, levels, self.count, self._steps)
        self._put({lamp: word for lamp, word in enumerate(words) if word}, doing)

    def off(self) -> None:
        self._show((), "putting all lamps off")

    def set_level(self, level: float) -> None:
        """Set the level of the lamps that are on, and of the next ones."""
        doing = f"setting the level to {level:g}"
        word = limits.level_word(self.name, doing, level, self._steps)
        with self._lock:
            if set(self._on.values()) - {word}:
                self._put(dict.fromkeys(self._on, word), doing)
            self._level = word

    def set_watchdog(self, seconds: float) -> None:
        raise limits.cannot(self.name, f"setting the watchdog to {seconds:g} s", "a watchdog")

    def heartbeat(self) -> None:
        raise limits.cannot(self.name, "sending a heartbeat", "a watchdog")

    def claim(self, number: int, name: str) -> str | None:
        raise limits.cannot(self.name, "taking the stage", "an owner register")

    def status(self) -> LightStatus:
        raise limits.cannot(self.name, "reading the status", "read-back")

    def load_sequence(self, entries: Sequence[tuple[Lit, float]]) -> None:
        doing = f"loading a sequence of {len(entries)} steps"
        raise limits.cannot(self.name, doing, "a sequence table")

    def position(self) -> int:
        raise limits.cannot(self.name, "reading the position in the sequence", "a sequence table")

    @abstractmethod
    def connect(self) -> None: ...

    @abstractmethod
    def close(self) -> None: ...

    @abstractmethod
    def _transmit(self, frames: Sequence[bytes], doing: str) -> None:
        """Send a frame of 512 channels to each universe; returns once the lamps have it."""

    def _show(self, lamps: Iterable[int], doing: str) -> None:
        self._put(dict.fromkeys(lamps, self._level), doing)

    def _put(self, on: dict[int, int], doing: str) -> None:
        frames = [bytearray(CHANNELS) for _ in range(self.universes)]
        for lamp, word in on.items():
            universe, channel = self.place(lamp)
            frames[universe][channel : channel + self._width] = bytes([word] * self._width)
        with self._lock:
            self._transmit([bytes(frame) for frame in frames], doing)
            self._on = on

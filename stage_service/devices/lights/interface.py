"""What the sequencer asks of a light bank."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True)
class LightStatus:
    """What the bank says of itself; `lit` counts the lamps that are on."""

    watchdog_tripped: bool
    interlock_open: bool
    estop_pressed: bool
    lit: int


class LightBank(Protocol):
    """Lamps `0 … count - 1` in the order of the rig. Safe to call from several threads.

    Flags say what the link can do: `can_read_back` that a blackout can be verified, `has_watchdog`
    that the lamps go off by themselves when heartbeats stop. Every call raises `DeviceError`.
    """

    name: str
    can_read_back: bool
    has_watchdog: bool

    @property
    def count(self) -> int:
        """Number of lamps; known after `connect`."""
        ...

    def connect(self) -> None:
        """Open the link and check that the right device answers."""
        ...

    def close(self) -> None:
        """Close the link; the lamps stay as they are."""
        ...

    def select(self, lamp: int) -> None:
        """Put exactly this lamp on, and confirm that one lamp is lit."""
        ...

    def all_on(self) -> None:
        """Put every lamp on, and confirm it."""
        ...

    def off(self) -> None:
        """Put every lamp off, and confirm it where the link can."""
        ...

    def set_level(self, level: float) -> None:
        """Set the level of every lamp, 0 to 1; does nothing where it is set already."""
        ...

    def set_watchdog(self, seconds: float) -> None:
        """Set after how long without a heartbeat the lamps go off."""
        ...

    def heartbeat(self) -> None:
        """Tell the watchdog that somebody is there."""
        ...

    def status(self) -> LightStatus:
        """Read the status back."""
        ...

"""The interface of a light bank."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

Lit = int | Literal["all", "none"]
"""What an entry of a sequence lights: one lamp by number, every lamp, or none."""


@dataclass(frozen=True)
class LightCapabilities:
    """Abilities of link and device.

    `reads_back`: a blackout can be verified. `dead_man`: the lamps go off by themselves when
    heartbeats stop. `table`: entries of its sequence table, 0 without one. `owned`: it has an owner
    register.
    """

    reads_back: bool
    dead_man: bool
    table: int
    owned: bool = False


@dataclass(frozen=True)
class LightStatus:
    """The bank's status; `lit` counts the lamps that are on."""

    watchdog_tripped: bool
    interlock_open: bool
    estop_pressed: bool
    lit: int

    @property
    def causes(self) -> str:
        """Which of the three keeps lamps off now, as a suffix of a sentence; often empty."""
        return (
            ", its watchdog has tripped" * self.watchdog_tripped
            + ", the interlock is open" * self.interlock_open
            + ", the emergency stop is pressed" * self.estop_pressed
        )


CONTRADICTED = "reported lamps as off that were commanded on"
"""Puts the bank's read-back of "dark" in doubt; the console searches for this text."""


def lamps_lit(count: int) -> str:
    """A number of lit lamps, for errors."""
    return f"{count} lamp{'' if count == 1 else 's'} lit"


def mismatch_todo(expected: int, status: LightStatus) -> str:
    """What to do where a bank reports another number of lit lamps than was commanded."""
    if status.causes:
        return "Clear the cause at the stage."
    if status.lit < expected:
        return f"The bank {CONTRADICTED}: look at the lamps, and check their drivers' supply."
    return "Check the lamp drivers, and that no other program writes to the bank."


class LightBank(Protocol):
    """Lamps `0 … count - 1` in the order of the rig. Safe to call from several threads.

    Every call raises `DeviceError`, also where the capabilities exclude it.
    """

    name: str
    capabilities: LightCapabilities

    @property
    def count(self) -> int:
        """Number of lamps, as the rig file has it and `connect` has confirmed it."""

    def connect(self) -> None:
        """Open the link and check the device's identity."""

    def close(self) -> None:
        """Close the link; the lamps stay as they are."""

    def select(self, lamp: int) -> None:
        """Put exactly this lamp on, and confirm that one lamp is lit where the link can."""

    def all_on(self) -> None:
        """Put every lamp on, and confirm it where the link can."""

    def show(self, levels: Sequence[float]) -> None:
        """Put each lamp on at its level `(count,)`, 0 to 1, and those at 0 off; confirm the number
        of lit ones where the link can. `set_level` is needed again before other commands."""

    def off(self) -> None:
        """Put every lamp off and leave a sequence; confirm it where the link can."""

    def set_level(self, level: float) -> None:
        """Set the level of every lamp, 0 to 1; does nothing if it is set already."""

    def set_watchdog(self, seconds: float) -> None:
        """Set after how long without a heartbeat the lamps go off."""

    def heartbeat(self) -> None:
        """Feed the watchdog."""

    def claim(self, number: int, name: str) -> str | None:
        """Take the bank for the service `number`, 1 to 65535; 0 releases it.

        Returns None, or the name of the other service that has the bank and keeps it.
        """

    def status(self) -> LightStatus:
        """Read the status back."""

    def load_sequence(self, entries: Sequence[tuple[Lit, float]]) -> None:
        """Upload (what, level) per step, verify and arm it: all dark until the gate opens."""

    def position(self) -> int:
        """How many steps of the armed sequence are over."""

"""The interface of a projector controller."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True)
class ProjectorCapabilities:
    """Abilities of link and device.

    `reads_back`: a blackout can be verified. `dead_man`: the projectors go dark by themselves
    without requests. `table`: entries of its sequence, which the trigger box steps; 0: no sequence.
    """

    reads_back: bool
    dead_man: bool
    table: int


@dataclass(frozen=True)
class Pattern:
    """One step of a sequence at `level`, 0 to 1: a row, or every row (no projector)."""

    level: float
    projector: str | None = None
    row: int = 0


class ProjectorController(Protocol):
    """Shows scanlines. Safe to call from several threads.

    Every call raises `DeviceError`, also where the capabilities exclude it. `line`, `all_on` and
    `load_sequence` raise `NotPermitted` without a live permission of the calling thread.
    """

    name: str
    capabilities: ProjectorCapabilities
    """Known after `connect`."""

    @property
    def names(self) -> tuple[str, ...]:
        """The projectors that the controller drives; known after `connect`."""

    def connect(self) -> None:
        """Open the link and check the device's identity."""

    def close(self) -> None:
        """Close the link; the projectors stay as they are."""

    def line(self, projector: str, row: int, level: float) -> None:
        """Show one row of one projector at `level`, 0 to 1; the others are dark."""

    def all_on(self, level: float) -> None:
        """Show every row of every projector at `level`, 0 to 1."""

    def off(self) -> None:
        """Put every projector dark and leave a sequence."""

    def is_dark(self) -> bool:
        """Read back whether every projector is dark."""

    def load_sequence(self, patterns: Sequence[Pattern]) -> None:
        """Upload one pattern per step, verify and arm it: all dark until the gate opens."""

    def position(self) -> int:
        """How many patterns of the armed sequence are over. Raises when none is armed, because a
        command or the watchdog left it."""

    def set_watchdog(self, seconds: float) -> None:
        """Set after how long without a request the projectors go dark and leave a sequence."""

    def heartbeat(self) -> None:
        """Feed the watchdog."""

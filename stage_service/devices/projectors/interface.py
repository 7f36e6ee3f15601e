"""What the sequencer asks of a projector controller."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True)
class ProjectorCapabilities:
    """What link and device can do.

    `reads_back`: a blackout can be verified. `dead_man`: the projectors go dark by themselves when
    nobody asks. `table`: entries of its sequence, which steps with the trigger box; 0: no sequence.
    """

    reads_back: bool
    dead_man: bool
    table: int


@dataclass(frozen=True)
class Pattern:
    """What one step of a sequence shows at `level`, 0 to 1: a row, or everything (no projector)."""

    level: float
    projector: str | None = None
    row: int = 0


class ProjectorController(Protocol):
    """Shows scanlines. Safe to call from several threads.

    Every call raises `DeviceError`; what the capabilities exclude raises it, too. `line`, `all_on`
    and `load_sequence` raise `NotPermitted` where the thread uses no live permission.
    """

    name: str
    capabilities: ProjectorCapabilities
    """Known after `connect`; nothing is promised before."""

    @property
    def names(self) -> tuple[str, ...]:
        """The projectors that the controller drives; known after `connect`."""

    def connect(self) -> None:
        """Open the link and check that the right device answers."""

    def close(self) -> None:
        """Close the link; the projectors stay as they are."""

    def line(self, projector: str, row: int, level: float) -> None:
        """Let one projector show one row at `level`, 0 to 1; every other one is dark."""

    def all_on(self, level: float) -> None:
        """Let every projector show every row at `level`, 0 to 1."""

    def off(self) -> None:
        """Put every projector dark and leave a sequence."""

    def is_dark(self) -> bool:
        """Read back whether every projector is dark."""

    def load_sequence(self, patterns: Sequence[Pattern]) -> None:
        """Upload one pattern per step, verify and arm it: all dark until the gate opens."""

    def position(self) -> int:
        """How many patterns of the armed sequence are over. Raises when none is armed any more:
        a command left it, or the watchdog did."""

    def set_watchdog(self, seconds: float) -> None:
        """Set after how long without a request the projectors go dark and leave a sequence."""

    def heartbeat(self) -> None:
        """Tell the watchdog that somebody is there."""

"""What the sequencer asks of a trigger box."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol


@dataclass(frozen=True)
class TriggerStatus:
    """The stage's safety inputs as the box sees them; reported, never cleared from here."""

    interlock_open: bool
    estop_pressed: bool


Gates = Literal["L", "P", "LP", "-"]
"""Which gates a step opens: the light bank's, the projectors', both, none."""
TableState = Literal["idle", "armed", "running", "done", "stopped"]


@dataclass(frozen=True)
class TableRow:
    """`repeat` steps alike of a hardware-stepped sequence; times in seconds.

    `gates` open ("L" light bank, "P" projectors), `settle_s` later the cameras fire, after
    `exposure_s` the gates close; the next step begins `period_s` after this one at the earliest.
    Settle 0 to 1 s, exposure 1e-6 to 10 s, period 0 to 60 s, each rounded to microseconds.
    """

    repeat: int
    gates: Gates
    settle_s: float
    exposure_s: float
    period_s: float


@dataclass(frozen=True)
class TableProgress:
    """Where a table is: `steps` and `pulses` since `go`; `reason` says why it stopped, or "-".

    A step counts when its gates have closed, a pulse when the cameras fire: within an exposure, and
    where a table was stopped in one, `pulses` is `steps` + 1.
    """

    state: TableState
    steps: int
    pulses: int
    reason: str


class TriggerBox(Protocol):
    """Fires all cameras at once and counts its pulses. Every call raises `DeviceError`."""

    name: str

    @property
    def table_rows(self) -> int:
        """Rows of its table, 0 where it has none; known after `connect`."""

    def connect(self) -> None:
        """Open the link and check that the right device answers."""

    def close(self) -> None:
        """Close the link."""

    def pulse(self, exposure_s: float) -> int:
        """Fire once; returns the count, this pulse included. Never repeated on its own: a pulse
        whose answer is lost may have fired."""

    def count(self) -> int:
        """Pulses since `reset` or power-up."""

    def reset(self) -> None:
        """Set the count to 0."""

    def status(self) -> TriggerStatus:
        """Read the safety inputs."""

    def load_table(self, rows: Sequence[TableRow], watchdog_s: float) -> None:
        """Upload a table, verify its checksum, and arm it; it stops by itself when nobody asks
        for `watchdog_s` seconds. Raises `ValueError` for times out of range; `DeviceError` where
        the box has no table, or too short a one. Neighbours alike share a row of the table."""

    def go(self) -> None:
        """Run the armed table from its first step, which opens the gates of lamps and projectors.
        Never repeated on its own: the table of a lost answer may run; `stop` ends it. Raises
        `NotPermitted` where the thread uses no live permission."""

    def progress(self) -> TableProgress:
        """Where the table is; feeds the box's watchdog."""

    def stop(self) -> int:
        """Close the gates at once and leave the table; returns the steps that were done. May be
        repeated."""

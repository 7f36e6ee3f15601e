"""The interface of a trigger box."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol


@dataclass(frozen=True)
class TriggerStatus:
    """The stage's safety inputs; the service never clears them."""

    interlock_open: bool
    estop_pressed: bool


Gates = Literal["L", "P", "LP", "-"]
"""Which gates a step opens: the light bank's, the projectors', both, none."""
TableState = Literal["idle", "armed", "running", "done", "stopped"]


@dataclass(frozen=True)
class TableRow:
    """`repeat` equal steps of a hardware-stepped sequence; times in seconds.

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
    """Progress of a table: `steps` and `pulses` since `go`; `reason`: why it stopped, or "-".

    A step counts once its gates have closed, a pulse once the cameras fire: during an exposure, and
    after a stop in one, `pulses` is `steps` + 1.
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
        """Open the link and check the device's identity."""

    def close(self) -> None:
        """Close the link."""

    def pulse(self, exposure_s: float) -> int:
        """Fire once; returns the count, this pulse included. Not repeated after a lost reply: the
        pulse may have fired."""

    def count(self) -> int:
        """Pulses since `reset` or power-up."""

    def reset(self) -> None:
        """Set the count to 0."""

    def status(self) -> TriggerStatus:
        """Read the safety inputs."""

    def load_table(self, rows: Sequence[TableRow], watchdog_s: float) -> None:
        """Upload a table, verify its checksum, and arm it; the box stops it after `watchdog_s`
        seconds without a request. Raises `ValueError` for times out of range, `DeviceError` where
        the box has no table or too short a one. Consecutive equal rows share one."""

    def go(self) -> None:
        """Run the armed table, which opens the gates of lamps and projectors. Not repeated after a
        lost reply: the table may run until `stop`. Raises `NotPermitted` without a live permission
        of the calling thread."""

    def progress(self) -> TableProgress:
        """The table's progress; feeds the box's watchdog."""

    def stop(self) -> int:
        """Close the gates at once and leave the table; returns the steps that were done. May be
        repeated."""

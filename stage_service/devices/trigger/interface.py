"""What the sequencer asks of a trigger box."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True)
class TriggerStatus:
    """The stage's safety inputs as the box sees them; reported, never cleared from here."""

    interlock_open: bool
    estop_pressed: bool


class TriggerBox(Protocol):
    """Fires all cameras at once and counts its pulses. Every call raises `DeviceError`."""

    name: str

    def connect(self) -> None:
        """Open the link and check that the right device answers."""
        ...

    def close(self) -> None:
        """Close the link."""
        ...

    def pulse(self, exposure_s: float) -> int:
        """Fire once; returns the count, this pulse included. Never repeated on its own: a pulse
        whose answer is lost may have fired."""
        ...

    def count(self) -> int:
        """Pulses since `reset` or power-up."""
        ...

    def reset(self) -> None:
        """Set the count to 0."""
        ...

    def status(self) -> TriggerStatus:
        """Read the safety inputs."""
        ...

"""What the sequencer asks of a projector controller."""

from __future__ import annotations

from typing import Protocol


class ProjectorController(Protocol):
    """Shows scanlines. Every call raises `DeviceError`.

    `can_read_back` says that `is_dark` asks the device, so that a blackout can be verified.
    """

    name: str
    can_read_back: bool

    @property
    def names(self) -> tuple[str, ...]:
        """The projectors that the controller drives; known after `connect`."""
        ...

    def connect(self) -> None:
        """Open the link and check that the right device answers."""
        ...

    def close(self) -> None:
        """Close the link; the projectors stay as they are."""
        ...

    def line(self, projector: str, row: int, level: float) -> None:
        """Let one projector show one row at `level`, 0 to 1; every other one is dark."""
        ...

    def all_on(self, level: float) -> None:
        """Let every projector show every row at `level`, 0 to 1."""
        ...

    def off(self) -> None:
        """Put every projector dark."""
        ...

    def is_dark(self) -> bool:
        """Read back whether every projector is dark."""
        ...

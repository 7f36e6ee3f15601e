"""The projector controller on a serial port; `docs/wire.md` has its lines."""

from __future__ import annotations

import re
from collections.abc import Sequence

from stage_service.config import SerialConfig
from stage_service.devices.errors import DeviceError
from stage_service.devices.projectors.interface import Pattern, ProjectorCapabilities
from stage_service.devices.serial_lines import SerialLines

FULL_LEVEL = 65535


class SerialProjectorController:
    """Implements `ProjectorController`; see there for the contract."""

    capabilities = ProjectorCapabilities(reads_back=True, sequences=False)

    def __init__(self, config: SerialConfig, expected: tuple[str, ...]) -> None:
        identity = re.compile(r"HAIRSTAGE-PROJECTORS (\S*)")
        self._lines = SerialLines("projector controller", config, identity)
        self._expected = expected
        self._names: tuple[str, ...] = ()
        self.name = self._lines.name

    @property
    def names(self) -> tuple[str, ...]:
        """The projectors that the controller drives."""
        return self._names

    def connect(self) -> None:
        """Open the port; raises `DeviceError` where a projector of the rig file is not driven."""
        self._names = tuple(n for n in self._lines.connect()[1].split(",") if n)
        absent = [n for n in self._expected if n not in self._names]
        if absent:
            raise DeviceError(
                self.name,
                "identifying",
                expected=f"the projectors {', '.join(self._expected)}",
                received=", ".join(self._names) or "none",
                todo="Use the rig file of this stage.",
            )

    def close(self) -> None:
        """Close the port; the projectors stay as they are."""
        self._lines.close()

    def line(self, projector: str, row: int, level: float) -> None:
        """Show one row of one projector; the echo is checked."""
        shown = f"LINE {projector} {row} {_level(level)}"
        self._lines.ask(shown, re.escape(f"OK {shown}"), f"showing row {row} of {projector}")

    def all_on(self, level: float) -> None:
        """Show every row of every projector; the echo is checked."""
        shown = f"ON {_level(level)}"
        self._lines.ask(shown, re.escape(f"OK {shown}"), "showing all rows")

    def off(self) -> None:
        """Put every projector dark; the echo is checked."""
        self._lines.ask("OFF", "OK OFF", "putting the projectors dark")

    def is_dark(self) -> bool:
        """Ask the controller what it shows."""
        return self._lines.ask("SHOW?", "SHOW (.+)", "reading what is shown")[1] == "OFF"

    def load_sequence(self, patterns: Sequence[Pattern]) -> None:
        """Not there yet."""
        raise NotImplementedError

    def position(self) -> int:
        """Not there yet."""
        raise NotImplementedError


def _level(level: float) -> int:
    if not 0 <= level <= 1:
        raise ValueError(f"a projector's level is 0 to 1, got {level}")
    return round(level * FULL_LEVEL)

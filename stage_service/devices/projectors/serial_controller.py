"""The projector controller on a serial port; `docs/reference/wire.md` has its lines."""

from __future__ import annotations

import re
from collections.abc import Sequence

from stage_service.config import PROJECTOR_LEVELS
from stage_service.device_config import SerialConfig
from stage_service.devices.errors import DeviceError
from stage_service.devices.permission import lighting
from stage_service.devices.projectors.interface import Pattern, ProjectorCapabilities
from stage_service.devices.serial_lines import Identity, SerialLines

IDENTITY = Identity(
    "HAIRSTAGE-PROJECTORS",
    re.compile(r"HAIRSTAGE-PROJECTORS (?:2 (\d+) )?(\S*)"),
    "a projector controller: 'HAIRSTAGE-PROJECTORS 2', the entries that it holds and the "
    "projectors' names, separated by commas, without blanks; or the names alone",
)


class SerialProjectorController:
    """Implements `ProjectorController`; see there for the contract."""

    def __init__(self, config: SerialConfig, expected: tuple[str, ...]) -> None:
        self._lines = SerialLines("projector controller", config, IDENTITY)
        self._expected = expected
        self.names: tuple[str, ...] = ()
        self.capabilities = ProjectorCapabilities(reads_back=True, dead_man=False, table=0)
        self.name = self._lines.name

    def connect(self) -> None:
        """Open the port; raises `DeviceError` where a projector of the rig file is not driven."""
        identity = self._lines.connect()
        second = identity[1] is not None
        self.capabilities = ProjectorCapabilities(True, second, int(identity[1] or 0))
        self.names = tuple(n for n in identity[2].split(",") if n)
        absent = [n for n in self._expected if n not in self.names]
        if absent:
            expected = f"the projectors {', '.join(self._expected)}"
            received = ", ".join(self.names) or "none"
            todo = "Use the rig file of this stage."
            raise DeviceError(self.name, "identifying", expected, received, todo)

    def close(self) -> None:
        self._lines.close()

    def line(self, projector: str, row: int, level: float) -> None:
        shown = f"LINE {projector} {row} {_level(level)}"
        doing = f"showing row {row} of {projector}"
        with lighting(doing):
            self._lines.echo(shown, doing)

    def all_on(self, level: float) -> None:
        shown, doing = f"ON {_level(level)}", "showing all rows"
        with lighting(doing):
            self._lines.echo(shown, doing)

    def off(self) -> None:
        self._lines.echo("OFF", "putting the projectors dark")

    def is_dark(self) -> bool:
        return self._lines.request("SHOW?", "SHOW <text>", "reading what is shown")[1] == "OFF"

    def load_sequence(self, patterns: Sequence[Pattern]) -> None:
        """Upload in runs of rows, compare checksum and number of patterns with our own, and leave
        the controller armed."""
        entries = [_text(run) for run in _runs(patterns)]
        words = ("SEQ", "ENTRY", "sequence", "entries")
        with lighting("arming a sequence of rows"):
            self._lines.upload(words, entries, self.capabilities.table, len(patterns))

    def position(self) -> int:
        """How often the gate has closed since the sequence was armed."""
        doing = "reading the sequence's position"
        match = self._lines.request("SEQ?", "SEQ <armed|idle|watchdog> <n>", doing)
        if match[1] != "armed":
            tripped = match[1] == "watchdog"
            received = f"{match[1]}, after {match[2]} patterns"
            todo = "Load the sequence first; line, all_on and off leave it."
            if tripped:
                todo = "It received no request for the watchdog time and put the projectors dark."
            raise DeviceError(self.name, doing, "an armed sequence", received, todo)
        return int(match[2])

    def set_watchdog(self, seconds: float) -> None:
        """Set the watchdog time, 0.1 to 60 s; version 1 of the controller refuses it."""
        self._lines.set_watchdog(seconds)

    def heartbeat(self) -> None:
        """Any request counts; this one changes nothing."""
        self._lines.request("SHOW?", "SHOW <text>", "feeding the watchdog")


def _runs(patterns: Sequence[Pattern]) -> list[list[Pattern]]:
    """Consecutive patterns that one entry describes: rows at equal steps and one level."""
    runs: list[list[Pattern]] = []
    for pattern in patterns:
        run = runs[-1] if runs else []
        alike = (
            run
            and pattern.projector is not None
            and (run[0].projector, run[0].level) == (pattern.projector, pattern.level)
            and (len(run) == 1 or pattern.row - run[-1].row == run[1].row - run[0].row)
        )
        if alike:
            run.append(pattern)
        else:
            runs.append([pattern])
    return runs


def _text(run: list[Pattern]) -> str:
    first, level = run[0], _level(run[0].level)
    if first.projector is None:
        return f"ON {level}"
    step = run[1].row - first.row if len(run) > 1 else 1
    return f"LINE {first.projector} {first.row} {step} {len(run)} {level}"


def _level(level: float) -> int:
    if not 0 <= level <= 1:
        raise ValueError(f"a projector's level is 0 to 1, got {level}")
    return round(level * PROJECTOR_LEVELS)

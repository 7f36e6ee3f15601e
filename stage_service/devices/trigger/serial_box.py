"""The trigger box on a serial port; `docs/reference/wire.md` has its lines."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import groupby
from typing import cast, get_args

from stage_service.device_config import SerialConfig
from stage_service.devices.errors import DeviceError
from stage_service.devices.permission import lighting
from stage_service.devices.serial_lines import Identity, SerialLines
from stage_service.devices.trigger.interface import (
    Gates,
    TableProgress,
    TableRow,
    TableState,
    TriggerStatus,
)

IDENTITY = Identity(
    "HAIRSTAGE-TRIGGER",
    re.compile(r"HAIRSTAGE-TRIGGER (?:1|2 (\d+))"),
    "a trigger box: 'HAIRSTAGE-TRIGGER 1', or 'HAIRSTAGE-TRIGGER 2' and its table rows",
)
MOST_REPEATS = 1_000_000
LONGEST_US = {"settle": 1_000_000, "exposure": 10_000_000, "period": 60_000_000}


class SerialTriggerBox:
    """Implements `TriggerBox`; see there for the contract."""

    def __init__(self, config: SerialConfig) -> None:
        self._lines = SerialLines("trigger box", config, IDENTITY)
        self.table_rows = 0  # version 1 of the box has none
        self.name = self._lines.name

    def connect(self) -> None:
        """Open the port; raises `DeviceError` where no trigger box replies."""
        self.table_rows = int(self._lines.connect()[1] or 0)

    def close(self) -> None:
        self._lines.close()

    def pulse(self, exposure_s: float) -> int:
        """Fire all cameras once for 1 µs to 10 s; returns the count."""
        us = self._microseconds("exposure", exposure_s, 1)
        return int(self._lines.request(f"PULSE {us}", "OK <n>", "firing the cameras")[1])

    def count(self) -> int:
        return int(self._lines.request("COUNT?", "COUNT <n>", "reading the pulse count")[1])

    def reset(self) -> None:
        self._lines.request("RESET", "OK 0", "resetting the pulse count")

    def status(self) -> TriggerStatus:
        reply = "STATUS interlock=<0|1> estop=<0|1>"
        match = self._lines.request("STATUS?", reply, "reading the safety inputs")
        return TriggerStatus(match[1] == "1", match[2] == "1")

    def load_table(self, rows: Sequence[TableRow], watchdog_s: float) -> None:
        """Upload, compare checksum and number of steps with our own, and leave the box armed."""
        texts = [self._text(row) for row in _joined(rows)]
        if self.table_rows == 0:
            expected = "a box that runs tables"
            received = "one without (version 1, or 0 rows)"
            todo = "Set hardware_stepping = false in [devices], or update the box's firmware."
            raise DeviceError(self.name, "uploading a table", expected, received, todo)
        self._lines.set_watchdog(watchdog_s)
        words, steps = ("TABLE", "ROW", "table", "rows"), sum(row.repeat for row in rows)
        self._lines.upload(words, texts, self.table_rows, steps)

    def go(self) -> None:
        """Run the armed table; raises `SafetyRefusal` where the box refuses to."""
        with lighting("starting the table"):
            self._lines.echo("GO", "starting the table")

    def progress(self) -> TableProgress:
        reply = f"SEQ <{'|'.join(get_args(TableState))}> <n> <n> <word>"
        match = self._lines.request("SEQ?", reply, "reading the table's progress")
        # The pattern admits these states only.
        return TableProgress(cast("TableState", match[1]), int(match[2]), int(match[3]), match[4])

    def stop(self) -> int:
        return int(self._lines.request("STOP", "OK STOP <n>", "stopping the table")[1])

    def _text(self, row: TableRow) -> str:
        if row.gates not in get_args(Gates):
            raise ValueError(f"{self.name}: gates must be {get_args(Gates)}, got {row.gates!r}")
        times = (
            self._microseconds("settle", row.settle_s, 0),
            self._microseconds("exposure", row.exposure_s, 1),
            self._microseconds("period", row.period_s, 0),
        )
        return f"{row.repeat} {row.gates} {' '.join(map(str, times))}"

    def _microseconds(self, what: str, seconds: float, least: int) -> int:
        most = LONGEST_US[what]
        # In this order a NaN or an infinity fails the comparison, not the rounding.
        if not -1 < seconds * 1e6 < most + 1 or not least <= (us := round(seconds * 1e6)) <= most:
            limits = f"{least * 1e-6:g} to {most * 1e-6:g} s"
            raise ValueError(f"{self.name}: {what} must be {limits}, got {seconds}")
        return us


def _joined(rows: Sequence[TableRow]) -> list[TableRow]:
    """Consecutive equal rows as one, up to `MOST_REPEATS`."""
    out: list[TableRow] = []
    for row in rows:
        if row.repeat < 1:
            raise ValueError(f"a row is repeated 1 or more times, got {row.repeat}")
    for row, equal in groupby(rows, lambda row: replace(row, repeat=1)):
        left = sum(r.repeat for r in equal)
        while left > 0:
            out.append(replace(row, repeat=min(left, MOST_REPEATS)))
            left -= MOST_REPEATS
    return out

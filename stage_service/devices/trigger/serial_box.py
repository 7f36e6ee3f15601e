"""The trigger box on a serial port; `docs/wire.md` has its lines."""

from __future__ import annotations

import re
from collections.abc import Sequence

from stage_service.config import SerialConfig
from stage_service.devices.serial_lines import SerialLines
from stage_service.devices.trigger.interface import TableProgress, TableRow, TriggerStatus


class SerialTriggerBox:
    """Implements `TriggerBox`; see there for the contract."""

    def __init__(self, config: SerialConfig) -> None:
        self._lines = SerialLines(
            "trigger box", config, re.compile(r"HAIRSTAGE-TRIGGER (?:1|2 \d+)")
        )
        self.name = self._lines.name

    def connect(self) -> None:
        """Open the port; raises `DeviceError` where no trigger box answers."""
        self._lines.connect()

    def close(self) -> None:
        """Close the port."""
        self._lines.close()

    def pulse(self, exposure_s: float) -> int:
        """Fire all cameras once for 1 µs to 10 s; returns the count."""
        us = round(exposure_s * 1e6)
        if not 1 <= us <= 10_000_000:
            raise ValueError(f"{self.name}: exposure must be 1e-6 to 10 s, got {exposure_s}")
        return int(self._lines.ask(f"PULSE {us}", r"OK (\d+)", "firing the cameras")[1])

    def count(self) -> int:
        """Pulses since `reset` or power-up."""
        return int(self._lines.ask("COUNT?", r"COUNT (\d+)", "reading the pulse count")[1])

    def reset(self) -> None:
        """Set the count to 0."""
        self._lines.ask("RESET", r"OK 0", "resetting the pulse count")

    def status(self) -> TriggerStatus:
        """Read interlock and emergency stop."""
        reply = r"STATUS interlock=([01]) estop=([01])"
        match = self._lines.ask("STATUS?", reply, "reading the safety inputs")
        return TriggerStatus(match[1] == "1", match[2] == "1")

    @property
    def table_rows(self) -> int:
        """Not there yet."""
        return 0

    def load_table(self, rows: Sequence[TableRow], watchdog_s: float) -> None:
        """Not there yet."""
        raise NotImplementedError

    def go(self) -> None:
        """Not there yet."""
        raise NotImplementedError

    def progress(self) -> TableProgress:
        """Not there yet."""
        raise NotImplementedError

    def stop(self) -> int:
        """Not there yet."""
        raise NotImplementedError

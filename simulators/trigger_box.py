"""The trigger box's side of its serial protocol (docs/wire.md)."""

from __future__ import annotations

from typing import Protocol

from simulators.faults import Faults
from simulators.serial_peer import UNKNOWN, UNSAFE, Refusal, whole

LONGEST_EXPOSURE_US = 10_000_000


class Stage(Protocol):
    """What the trigger box is wired to."""

    @property
    def pulses(self) -> int:
        """Pulses since reset."""

    def pulse(self) -> int:
        """Fire the cameras; returns the count with this pulse."""

    def reset(self) -> None:
        """Set the count to 0."""

    def safety(self) -> tuple[bool, bool]:
        """Whether the interlock is open, and whether the emergency stop is pressed."""


class TriggerBox:
    """Answers lines; `SerialPeer` carries them."""

    def __init__(self, stage: Stage, faults: Faults) -> None:
        self._stage = stage
        self._faults = faults

    def reply(self, line: str) -> str | None:
        """The answer to one request, or None where a fault swallows it; raises `Refusal`."""
        match line.split(" "):
            case ["ID?"]:
                return "HAIRSTAGE-TRIGGER 1"
            case ["PULSE", exposure]:
                return self._pulse(exposure)
            case ["COUNT?"]:
                return f"COUNT {self._stage.pulses}"
            case ["RESET"]:
                self._stage.reset()
                return "OK 0"
            case ["STATUS?"]:
                interlock, estop = self._stage.safety()
                return f"STATUS interlock={int(interlock)} estop={int(estop)}"
        raise Refusal(UNKNOWN, "unknown command")

    def _pulse(self, exposure: str) -> str | None:
        whole(exposure, 1, LONGEST_EXPOSURE_US, "exposure")
        interlock, estop = self._stage.safety()
        if interlock or estop:
            raise Refusal(UNSAFE, "emergency stop pressed" if estop else "interlock open")
        count = self._stage.pulse()
        if self._faults.once("trigger", "silent", count):
            return None
        if self._faults.once("trigger", "garbage", count):
            return f"O\x7f {count}?"
        return f"OK {count}"

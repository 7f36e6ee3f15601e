"""The projector controller's side of its serial protocol (docs/wire.md), and what is shown."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from reconstruction.projectors import Projector
from simulators.faults import Faults
from simulators.serial_peer import BAD_ARGUMENT, UNKNOWN, Refusal, whole

FULL = 65535


@dataclass(frozen=True)
class Show:
    """What the projectors show: nothing (level 0), all rows of all, or one row of one."""

    level: int = 0
    projector: str | None = None
    row: int = 0

    @property
    def power(self) -> float:
        """Share of full intensity, 0 to 1."""
        return self.level / FULL

    @property
    def everything(self) -> bool:
        """Whether all projectors show all rows: a tracking exposure."""
        return self.projector is None and self.level > 0


class ProjectorController:
    """Answers lines; `SerialPeer` carries them. `pulses()` counts for the faults."""

    def __init__(
        self, projectors: Sequence[Projector], faults: Faults, pulses: Callable[[], int]
    ) -> None:
        self._rows = {p.name: p.height for p in projectors}
        self._faults = faults
        self._pulses = pulses
        self._lock = threading.Lock()
        self._show = Show()
        self._said = "OFF"

    @property
    def show(self) -> Show:
        """What is shown now."""
        with self._lock:
            return self._show

    def reply(self, line: str) -> str | None:
        """The answer to one request, or None where a fault swallows it; raises `Refusal`."""
        answer = self._carry_out(line)
        if self._faults.once("projectors", "silent", self._pulses()):
            return None
        if self._faults.once("projectors", "garbage", self._pulses()):
            return answer[: len(answer) // 2] + "\x7f"
        return answer

    def _carry_out(self, line: str) -> str:
        match line.split(" "):
            case ["ID?"]:
                return f"HAIRSTAGE-PROJECTORS {','.join(self._rows)}"
            case ["SHOW?"]:
                with self._lock:
                    return f"SHOW {self._said}"
            case ["OFF"]:
                return self._set(Show(), "OFF")
            case ["ON", level]:
                return self._set(Show(whole(level, 0, FULL, "level")), f"ON {int(level)}")
            case ["LINE", name, row, level]:
                if name not in self._rows:
                    raise Refusal(BAD_ARGUMENT, f"unknown projector {name}")
                index = whole(row, 0, self._rows[name] - 1, "row")
                show = Show(whole(level, 0, FULL, "level"), name, index)
                return self._set(show, f"LINE {name} {index} {int(level)}")
        raise Refusal(UNKNOWN, "unknown command")

    def _set(self, show: Show, said: str) -> str:
        with self._lock:
            self._show, self._said = show, said
        return f"OK {said}"

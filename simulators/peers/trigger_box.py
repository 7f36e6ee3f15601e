"""The trigger box's side of its serial protocol (docs/reference/wire.md)."""

from __future__ import annotations

import binascii
import threading
import time
from dataclasses import dataclass
from typing import Protocol

from simulators.peers.faults import Faults
from simulators.peers.serial_peer import (
    BAD_ARGUMENT,
    NOT_NOW,
    UNKNOWN,
    UNSAFE,
    WATCHDOG_MS,
    Refusal,
    whole,
)

TABLE_ROWS = 4096
GATES = ("L", "P", "LP", "-")
_MOST_REPEATS = 1_000_000
_SETTLE_US, _EXPOSURE_US, _PERIOD_US = 1_000_000, 10_000_000, 60_000_000
_MISFIRES = {"double": {"fires": 2}, "dropped": {"fires": 0}, "uncounted": {"counts": 0}}
_TRIGGER_OUT_S = 0.1
_LOOK_S = 0.002
"""Seconds between checks of the inputs while a table waits."""


class Gated(Protocol):
    """A device wired to a gate of the box."""

    def gate(self, is_open: bool) -> None: ...


class GatedProjectors(Gated, Protocol):
    """The projector controller; its trigger-out wire says whether the pattern is up."""

    @property
    def trigger_out(self) -> bool: ...


class Wiring(Protocol):
    """The wiring of the trigger box, see `World`; pulses are counted since `reset`.

    `pulse` fires the cameras and returns the count; `safety` is whether the interlock is open, and
    the emergency stop pressed.
    """

    @property
    def pulses(self) -> int: ...
    @property
    def lamps(self) -> Gated: ...
    @property
    def projectors(self) -> GatedProjectors: ...
    def pulse(self, fires: int = 1, counts: int = 1) -> int: ...
    def reset(self) -> None: ...
    def safety(self) -> tuple[bool, bool]: ...


@dataclass(frozen=True)
class Row:
    """`repeat` equal steps; times in seconds. `text` is for the checksum."""

    repeat: int
    gates: str
    settle: float
    exposure: float
    period: float
    text: str


class _Stopped(Exception):
    """The table was stopped while a step waited."""


class SimulatedTriggerBox:
    """Executes request lines of a `SerialPeer`, and runs its table on its own thread.

    End with `stop`. The lock is held while the table acts and released while it waits.
    """

    def __init__(self, wiring: Wiring, faults: Faults) -> None:
        self._wiring, self._faults = wiring, faults
        self._changed = threading.Condition()
        self._ended = threading.Event()
        self._rows: list[Row] = []
        self._expected = 0
        self._state, self._reason = "idle", "-"
        self._steps = self._pulses = 0
        self._open = ""
        self._watchdog = 2.0
        self._fed = time.monotonic()
        self._runner: threading.Thread | None = None

    def stop(self) -> None:
        """Switch the box off: gates closed, its thread ended."""
        self._ended.set()
        with self._changed:
            self._end("stop")
        if self._runner is not None:
            self._runner.join()

    def reply(self, line: str) -> str:
        """The reply to one request; raises `Refusal`."""
        if line.startswith("PULSE "):
            self._delay()  # before the lock: a late box replies late
        with self._changed:
            reply = self._execute(line.split(" "))
            self._fed = time.monotonic()  # not by refusals: noise must not feed it
            return reply

    def _execute(self, words: list[str]) -> str:
        match words:
            case ["ID?"]:
                return f"HAIRSTAGE-TRIGGER 2 {TABLE_ROWS}"
            case ["PULSE", exposure]:
                whole(exposure, 1, _EXPOSURE_US, "exposure")
                self._refuse_while_running()
                self._refuse_unsafe()
                return f"OK {self._fire()}"
            case ["COUNT?"]:
                return f"COUNT {self._wiring.pulses}"
            case ["RESET"]:
                self._refuse_while_running()
                self._wiring.reset()
                return "OK 0"
            case ["STATUS?"]:
                interlock, estop = self._wiring.safety()
                return f"STATUS interlock={int(interlock)} estop={int(estop)}"
            case ["TABLE", count]:
                self._refuse_while_running()
                self._expected = whole(count, 1, TABLE_ROWS, "rows")
                self._rows, self._state, self._reason = [], "idle", "-"
                self._steps = self._pulses = 0
                return f"OK TABLE {self._expected}"
            case ["ROW", index, repeat, gates, settle, exposure, period]:
                return self._row(index, (repeat, gates, settle, exposure, period))
            case ["ARM"]:
                return self._arm()
            case ["GO"]:
                return self._go()
            case ["SEQ?"]:
                return f"SEQ {self._state} {self._steps} {self._pulses} {self._reason}"
            case ["STOP"]:
                if self._state == "armed":
                    self._state = "idle"
                self._end("stop")
                return f"OK STOP {self._steps}"
            case ["WATCHDOG", time_ms]:
                self._watchdog = whole(time_ms, *WATCHDOG_MS, "watchdog time") / 1000
                return f"OK WATCHDOG {int(time_ms)}"
        raise Refusal(UNKNOWN, "unknown command")

    def _row(self, index: str, words: tuple[str, ...]) -> str:
        self._refuse_while_running()
        if len(self._rows) >= self._expected or self._state == "armed":
            raise Refusal(NOT_NOW, "no row is expected")
        due = len(self._rows)
        whole(index, due, due, "row")
        repeat, gates, settle, exposure, period = words
        if gates not in GATES:
            raise Refusal(BAD_ARGUMENT, "gates must be L, P, LP or -")
        count = whole(repeat, 1, _MOST_REPEATS, "repeat")
        dark = whole(settle, 0, _SETTLE_US, "settle")
        lit = whole(exposure, 1, _EXPOSURE_US, "exposure")
        step = whole(period, 0, _PERIOD_US, "period")
        text = f"{count} {gates} {dark} {lit} {step}\n"
        self._rows.append(Row(count, gates, dark * 1e-6, lit * 1e-6, step * 1e-6, text))
        return f"OK ROW {due}"

    def _arm(self) -> str:
        self._refuse_while_running()
        if not self._expected or len(self._rows) < self._expected:
            raise Refusal(NOT_NOW, f"{len(self._rows)} of {self._expected} rows are there")
        self._state, self._reason = "armed", "-"
        self._steps = self._pulses = 0
        crc = binascii.crc32("".join(row.text for row in self._rows).encode())
        return f"OK ARM {sum(row.repeat for row in self._rows)} {crc:08x}"

    def _go(self) -> str:
        if self._state != "armed":
            raise Refusal(NOT_NOW, "not armed")
        self._refuse_unsafe()
        self._state = "running"
        self._fed = time.monotonic()
        self._runner = threading.Thread(target=self._run, name="trigger box", daemon=True)
        self._runner.start()
        return "OK GO"

    def _refuse_while_running(self) -> None:
        if self._state == "running":
            raise Refusal(NOT_NOW, "a table runs")

    def _refuse_unsafe(self) -> None:
        interlock, estop = self._wiring.safety()
        if interlock or estop:
            raise Refusal(UNSAFE, "emergency stop pressed" if estop else "interlock open")

    def _run(self) -> None:
        with self._changed:
            start = time.monotonic()
            try:
                for row in self._rows:
                    for _ in range(row.repeat):
                        self._until(start)
                        self._step(row)
                        start = max(start + row.period, time.monotonic())
            except _Stopped:
                return
            self._state = "done"

    def _step(self, row: Row) -> None:
        if "P" in row.gates:
            self._until_pattern(False)
        self._set_gates(row.gates)
        if "P" in row.gates:
            self._until_pattern(True)
        self._until(time.monotonic() + row.settle)
        late = self._faults.at("trigger", "late_trigger", self._wiring.pulses + 1)
        if late is not None:
            self._until(time.monotonic() + late.seconds)
        self._fire()
        self._pulses += 1
        self._until(time.monotonic() + row.exposure)
        self._set_gates("")
        self._steps += 1

    def _fire(self) -> int:
        due = self._wiring.pulses + 1
        for kind, what in _MISFIRES.items():
            if self._faults.at("trigger", kind, due):
                return self._wiring.pulse(**what)
        return self._wiring.pulse()

    def _delay(self) -> None:
        late = self._faults.at("trigger", "late_trigger", self._wiring.pulses + 1)
        if late is not None:
            self._ended.wait(late.seconds)

    def _until_pattern(self, up: bool) -> None:
        deadline = time.monotonic() + _TRIGGER_OUT_S
        while self._wiring.projectors.trigger_out != up:
            if time.monotonic() >= deadline:
                self._end("no-pattern")
            self._until(time.monotonic() + _LOOK_S)

    def _until(self, moment: float) -> None:
        """Wait while checking the inputs; raises `_Stopped` when the table has ended."""
        while True:
            interlock, estop = self._wiring.safety()
            if estop or interlock:
                self._end("estop" if estop else "interlock")
            elif time.monotonic() - self._fed > self._watchdog:
                self._end("watchdog")
            if self._state != "running":
                raise _Stopped
            left = moment - time.monotonic()
            if left <= 0:
                return
            self._changed.wait(min(left, _LOOK_S))

    def _end(self, reason: str) -> None:
        """Close the gates at once; a running table is stopped for `reason`."""
        self._set_gates("")
        if self._state == "running":
            self._state, self._reason = "stopped", reason
            self._changed.notify_all()

    def _set_gates(self, gates: str) -> None:
        wires: dict[str, Gated] = {"L": self._wiring.lamps, "P": self._wiring.projectors}
        for gate, device in wires.items():
            if (gate in gates) != (gate in self._open):
                device.gate(gate in gates)
        self._open = gates

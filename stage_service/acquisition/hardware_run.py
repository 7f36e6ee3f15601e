"""A run of steps that the trigger box clocks: upload, arm, go, collect the frames, check."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, groupby
from typing import Literal

from reconstruction import Step
from stage_service.acquisition.progress import RunProgress
from stage_service.devices.cameras.fan_out import FanOut
from stage_service.devices.cameras.interface import CameraDevice, Frame
from stage_service.devices.device_set import DeviceSet
from stage_service.devices.errors import Cancelled, DeviceError, IndexShift, SafetyRefusal
from stage_service.devices.lights.interface import LightBank, Lit
from stage_service.devices.projectors.interface import Pattern, ProjectorController
from stage_service.devices.trigger.interface import TableProgress, TableRow
from stage_service.plan.stepping import period_s

POLL_S = 0.02


@dataclass(frozen=True, eq=False)
class Shots:
    """What a run made: each camera's frames in order of arrival, and how far the box came.

    `error` is why the run ended early, unless it was stopped on request. Frames of finished steps
    are good; the frame of a later pulse was cut short. There are no frames where the positions of
    lamps and projectors could not confirm them after such an error.
    """

    frames: dict[str, list[Frame]]
    progress: TableProgress
    error: DeviceError | None


class HardwareRun:
    """One run on an armed stage. `shoot` blocks and polls `stop_requested` meanwhile."""

    def __init__(
        self,
        devices: DeviceSet,
        steps: Sequence[Step],
        lamp: dict[str, int],
        *,
        rate_hz: float | None,
        progress: RunProgress,
    ) -> None:
        self._devices, self._steps, self._lamp = devices, steps, lamp
        self._progress = progress
        settle = devices.config.lights.settle_s
        each = [
            TableRow(1, _gate(s), settle, s.exposure, period_s(s, devices.config, rate_hz))
            for s in steps
        ]
        self._rows = [replace(row, repeat=len(list(same))) for row, same in groupby(each)]
        self._schedule = list(accumulate((r.period_s for r in each[:-1]), initial=0.0))

    def shoot(
        self, cameras: FanOut, cancel: threading.Event, stop_requested: Callable[[], bool]
    ) -> Shots:
        """Run the table and collect the frames.

        Raises `DeviceError` where a device fails, `IndexShift` where lamps or projectors did not
        step with the box, `Cancelled` where `cancel` was set.
        """
        lights, beams = self._devices.lights, self._devices.projectors
        trigger = self._devices.trigger
        settle = self._devices.config.lights.settle_s
        begins = zip(self._steps, self._schedule, strict=True)
        lit = [(s, (at, at + settle + s.exposure)) for s, at in begins if _gate(s) == "L"]
        shown = [_pattern(s) for s in self._steps if _gate(s) == "P"]
        if lit:
            lights.load_sequence([_entry(s, self._lamp) for s, _ in lit], [t for _, t in lit])
        if shown:
            assert beams is not None
            beams.load_sequence(shown)
        trigger.load_table(self._rows, self._devices.config.watchdog_s)
        watch = _Watch(self._devices, stop_requested)
        if cancel.is_set():
            raise Cancelled("the capture is being stopped")
        try:
            trigger.go()
            watch.start()
            frames = cameras(
                lambda camera: self._collect(camera, watch.over, cancel),
                lambda: self._progress.waiting(self._devices.busy),
            )
        finally:
            watch.end()
        progress = watch.progress
        requested = progress.state == "stopped" and progress.reason == "stop"
        early = None if requested or progress.state == "done" else self._early(progress)
        try:
            self._check_stepped(progress)
        except DeviceError:
            if early is None:
                raise
            frames = {name: [] for name in frames}  # their lights are not confirmed
        return Shots(frames, progress, early)

    def _collect(
        self, camera: CameraDevice, over: threading.Event, cancel: threading.Event
    ) -> list[Frame]:
        frames: list[Frame] = []
        while True:
            # Checked before reading: the last pulse's frame is there once the box is done.
            last_look = over.is_set()
            frame = camera.read(cancel)
            if frame is not None:
                frames.append(frame)
                self._progress.came(camera.name)
            elif last_look:
                return frames
            elif cancel.is_set():
                raise Cancelled("the capture is being stopped")
            else:
                over.wait(POLL_S / 4)

    def _check_stepped(self, progress: TableProgress) -> None:
        """Raise `DeviceError` unless lamps and projectors stepped as far as the box."""
        lights, beams = self._devices.lights, self._devices.projectors
        lit, shown = (self._gates(gate, len(self._steps)) for gate in "LP")
        if lit and lights.capabilities.reads_back and lights.status().watchdog_tripped:
            expected = "a watchdog that was fed"
            received = "a tripped one: frames of this run may be dark"
            todo = "Check the load of the host and the link; raise watchdog_s."
            doing = "checking the watchdog after a hardware-stepped run"
            raise DeviceError(lights.name, doing, expected, received, todo)
        stepped: list[tuple[str, LightBank | ProjectorController]] = [("L", lights)] if lit else []
        if shown and beams is not None:
            stepped.append(("P", beams))
        for gate, device in stepped:
            # The gate of the step in which a table was stopped may have been open; during the
            # exposure it was, but a bank stopped by interlock or watchdog no longer counts.
            least, most = (self._gates(gate, progress.steps + more) for more in (0, 1))
            if progress.reason == "stop" and progress.pulses > progress.steps:
                least = most
            reached = device.position()
            if not least <= reached <= most:
                doing = "counting the steps of a hardware-stepped run"
                either = f", or {most}" if most > least else ""
                expected = f"{least} steps, as the trigger box's gate{either}"
                todo = "Check the gate's cable for lost or doubled edges. Its frames were dropped."
                raise IndexShift(device.name, doing, expected, f"{reached}", todo)

    def _gates(self, gate: str, steps: int) -> int:
        """How many of the first `steps` steps open this gate."""
        return sum(_gate(s) == gate for s in self._steps[:steps])

    def _early(self, progress: TableProgress) -> DeviceError:
        kind = SafetyRefusal if progress.reason in ("interlock", "estop") else DeviceError
        doing = f"running a table of {len(self._steps)} steps"
        received = f"{progress.state} after {progress.pulses} pulses ({progress.reason})"
        todo = _TODO.get(progress.reason, "Check the trigger box and its cable.")
        return kind(self._devices.trigger.name, doing, "all of them", received, todo)


_TODO = {
    "interlock": "Close the interlock at the stage; the service never does.",
    "estop": "Release the emergency stop at the stage; the service never does.",
    "watchdog": "The box received no request in time: check the cable and the host's load.",
    "no-pattern": "The projectors raised no trigger-out: check its cable and the projectors.",
}


class _Watch:
    """Polls the box's progress, which feeds its watchdog, until the table is over."""

    def __init__(self, devices: DeviceSet, stop_requested: Callable[[], bool]) -> None:
        self.over = threading.Event()
        self._progress: TableProgress | None = None
        self._trigger, self._stop_asked = devices.trigger, stop_requested
        self._error: Exception | None = None
        self._leave = threading.Event()
        self._thread = threading.Thread(target=self._run, name="table-watch", daemon=True)

    @property
    def progress(self) -> TableProgress:
        if self._error is not None:
            raise self._error
        assert self._progress is not None
        return self._progress

    def start(self) -> None:
        self._thread.start()

    def end(self) -> None:
        """Stop the box where it still runs."""
        self._leave.set()
        if self._thread.is_alive():
            self._thread.join()
        if self._progress is None or self._progress.state == "running":
            self._trigger.stop()

    def _run(self) -> None:
        try:
            while True:
                self._progress = self._trigger.progress()
                if self._progress.state != "running" or self._leave.wait(POLL_S):
                    return
                if self._stop_asked():
                    self._trigger.stop()
        except Exception as error:  # raised by `progress`
            self._error = error
        finally:
            self.over.set()


def _gate(step: Step) -> Literal["L", "P", "-"]:
    if step.kind in ("olat", "all_on"):
        return "L"
    return "-" if step.kind == "dark" else "P"


def _entry(step: Step, lamp: dict[str, int]) -> tuple[Lit, float]:
    return ("all" if step.light is None else lamp[step.light]), step.level


def _pattern(step: Step) -> Pattern:
    if step.kind == "tracking":
        return Pattern(step.level)
    assert step.row is not None
    return Pattern(step.level, step.projector, step.row)

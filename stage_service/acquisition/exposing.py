"""One software-stepped exposure: light, confirm, settle, fire, confirm, dark."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from reconstruction import Step
from stage_service.acquisition.timings import Timings
from stage_service.devices.cameras.fan_out import FanOut
from stage_service.devices.device_set import DeviceSet
from stage_service.devices.errors import Cancelled, DeviceError, SafetyRefusal
from stage_service.devices.lights.interface import CONTRADICTED, lamps_lit, mismatch_todo
from stage_service.plan.flash import FASTEST_HZ, SLOW_HZ, SLOWEST_HZ, Trains
from stage_service.plan.patterns import LAMP_KINDS, LampLevels


@dataclass(frozen=True)
class Pulse:
    """The trigger box's count, and the monotonic seconds between which it fired."""

    count: int
    requested: float
    replied: float


class Exposing:
    """Exposes a step on connected devices, at most `rate_hz` times a second.

    `watch` is called right before a step's light and raises what forbids it. Raises `DeviceError`
    where a device fails, `NotPermitted` without a live permission, `Cancelled` once `cancel` is
    set.
    """

    def __init__(
        self,
        devices: DeviceSet,
        lamp_levels: LampLevels,
        cancel: threading.Event,
        timings: Timings,
        rate_hz: float | None,
        watch: Callable[[Step], None] | None,
    ) -> None:
        self._watch, self._lamp_levels = watch, lamp_levels
        self._devices, self._cancel, self._timings = devices, cancel, timings
        self._period = 1 / rate_hz if rate_hz else 0.0
        self._next = 0.0

    def expose(self, step: Step, cameras: FanOut) -> Pulse:
        """Make one pulse in the step's light, and release the cameras that it does not fire.

        The light goes off when the exposure must be over, whether or not the cameras reply.
        """
        timings = self._timings
        with timings.on("rate limit"):
            self._sleep(self._next - time.monotonic())
        self._next = time.monotonic() + self._period
        if self._watch is not None:
            self._watch(step)
        with timings.on("lights"):
            self._light(step)
        with timings.on("settle"):
            self._sleep(self._devices.config.lights.settle_s)
        with timings.on("trigger"):
            requested = time.monotonic()
            count = self._devices.trigger.pulse(step.exposure)
            pulse = Pulse(count, requested, time.monotonic())
            lag = self._devices.config.cameras.lag_s
            if lag:
                cameras.start(lambda camera: camera.release())
        # Counted from the box's reply, which never precedes the pulse: the light stays long enough.
        with timings.on("exposure"):
            self._sleep(lag + step.exposure)
        with timings.on("lights"):
            self._check_lamps(step)
            self._check_projectors(step)
            self.dark(step)
        return pulse

    def dark(self, step: Step | None = None) -> None:
        """Put off what the step lit; without a step, everything."""
        if step is None or step.kind in LAMP_KINDS:
            self._devices.lights.off()
        projected = step is None or step.kind in ("scanline", "tracking")
        if projected and self._devices.projectors is not None:
            self._devices.projectors.off()

    def _light(self, step: Step) -> None:
        lights = self._devices.lights
        if step.kind in ("olat", "all_on"):
            lights.set_level(step.level)
        if step.light is not None:
            lights.select(int(self._lamp_levels(step).argmax()))
        elif step.kind == "all_on":
            lights.all_on()
        elif step.kind == "pattern":
            lights.show(self._lamp_levels(step).tolist())
        elif step.kind == "dark":
            self.dark()
        else:
            self._project(step)

    def _project(self, step: Step) -> None:
        projectors = self._devices.projectors
        if projectors is None:
            raise RuntimeError(f"step {step.index} ({step.kind}): the stage has no projectors")
        if step.kind == "tracking":
            projectors.all_on(step.level)
        else:
            assert step.projector is not None
            assert step.row is not None
            projectors.line(step.projector, step.row, step.level)

    def _check_lamps(self, step: Step) -> None:
        """Raise where lamps went off during the exposure: the frame would look like a dark one."""
        lights = self._devices.lights
        if step.kind not in LAMP_KINDS or not lights.capabilities.reads_back:
            return
        status, expected = lights.status(), int(np.count_nonzero(self._lamp_levels(step)))
        if status.lit != expected:
            doing = f"counting lit lamps after step {step.index} ({step.lighting or step.kind})"
            received, todo = f"{status.lit} lit{status.causes}", mismatch_todo(expected, status)
            lights.contradicted |= CONTRADICTED in todo
            raise DeviceError(lights.name, doing, lamps_lit(expected), received, todo)

    def _check_projectors(self, step: Step) -> None:
        """The same for projectors."""
        beams = self._devices.projectors
        projected = step.kind in ("scanline", "tracking")
        if projected and beams is not None and beams.capabilities.reads_back and beams.is_dark():
            doing = f"reading the projectors after the exposure of step {step.index}"
            todo = "Its watchdog switched it off, or it lost power: check its cable."
            raise DeviceError(beams.name, doing, "the row shown", "darkness", todo)

    def _sleep(self, seconds: float) -> None:
        if self._cancel.wait(max(0.0, seconds)):
            raise Cancelled("the capture is being stopped")


class FlashWatch:
    """Measures the flash rate while running. Call it right before each step's light.

    Raises `SafetyRefusal` before the flash that would bring the rate into the band.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._trains = Trains()
        self._lock = threading.Lock()

    def __call__(self, step: Step) -> None:
        if step.kind == "dark":
            return
        with self._lock:
            rate = self._trains.add(step, self._clock())
        if rate is not None:
            doing = f"lighting step {step.index} ({step.kind})"
            slow, fast = f"slower than {SLOWEST_HZ:g}", f"faster than {FASTEST_HZ:g} Hz"
            expected = f"flashes {slow} or {fast}: no consent is armed"
            todo = f"Set rate_hz to {SLOW_HZ:g} in the plan, or record consent and arm it."
            raise SafetyRefusal("stage", doing, expected, f"{rate:.1f} Hz", todo)

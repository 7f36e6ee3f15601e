"""Runs a plan's steps over a stage: light, confirm, pulse, dark, read, account, write."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

from reconstruction.capture import Step
from reconstruction.capture_writer import CaptureWriter
from stage_service.accounting import FrameAccount, PulseAccount
from stage_service.devices.cameras.fan_out import FanOut
from stage_service.devices.cameras.interface import Camera, Frame
from stage_service.devices.errors import Cancelled, DeviceError
from stage_service.devices.heartbeat import Heartbeat
from stage_service.devices.stage import Stage
from stage_service.safety import Blackout, blackout, check_interlocks
from stage_service.states import Machine, Outcome, State, WrongState
from stage_service.writer import FrameWriter, Shot

Notify = Callable[[str, dict[str, Any]], None]
QUEUED_STEPS = 2
"""Steps' worth of frames that may wait for the disk before the sequence waits, too."""


class Sequencer:
    """One run over the frames that a capture still lacks, so an interrupted one goes on where it
    stopped. `run` blocks; the other methods may be called from any thread.

    `notify(kind, data)` hears "capture.state", "capture.step" and "capture.frame_missing".
    Whatever ends the run, lamps and projectors are put off and read back.
    """

    def __init__(
        self,
        stage: Stage,
        writer: CaptureWriter,
        *,
        retries: int = 2,
        notify: Notify = lambda _kind, _data: None,
    ) -> None:
        self.stage = stage
        self.error: str | None = None
        self.blackout: Blackout | None = None
        self.steps_done = 0
        self._began: float | None = None
        self._ended: float | None = None
        self._writer = writer
        self._retries = retries
        self._notify = notify
        self._machine = Machine()
        self._changed = threading.Condition()
        self._pause_asked = False
        self._abort_asked = False
        self._cancel = threading.Event()
        self._lamp = {light.name: i for i, light in enumerate(writer.rig.lights)}
        self._armed: float | None = None
        self._pulses = PulseAccount(stage.trigger.name)
        self._accounts = {
            c.name: FrameAccount(c.name, c.capabilities.block_wrap) for c in stage.cameras
        }

    @property
    def state(self) -> State:
        """Where the run is."""
        return self._machine.state

    @property
    def outcome(self) -> Outcome | None:
        """How the run ends, as soon as that is decided."""
        return self._machine.outcome

    @property
    def seconds(self) -> float | None:
        """Seconds from the start until now, or until the end; None before the start."""
        if self._began is None:
            return None
        return (time.monotonic() if self._ended is None else self._ended) - self._began

    def pause(self) -> None:
        """Pause at the next step boundary, lights off. Raises `WrongState`."""
        with self._changed:
            self._require("pause")
            self._pause_asked = True
            self._changed.notify_all()

    def resume(self) -> None:
        """Go on, or take back a pause that has not begun. Raises `WrongState`."""
        with self._changed:
            if not self._pause_asked:
                self._require("resume")
            self._pause_asked = False
            self._changed.notify_all()

    def abort(self) -> None:
        """Abort at the next step boundary. Raises `WrongState`."""
        with self._changed:
            self._require("abort")
            self._abort_asked = True
            self._changed.notify_all()

    def stop_now(self) -> None:
        """Abort without waiting for the step's frames; does nothing when the run is over."""
        with self._changed:
            self._abort_asked = True
            self._cancel.set()
            self._changed.notify_all()

    def run(self) -> Outcome:
        """Shoot what is missing and finish the capture folder; returns the outcome.

        Trouble with a device, the disk or a frame ends in the outcome "failed" and `error`.
        KeyboardInterrupt and SystemExit are raised again after everything is in order.
        """
        self._began = time.monotonic()
        leave: BaseException | None = None
        self._move("start")
        try:
            self._session()
            self._move("complete")
        except Cancelled:
            self._move("abort")
        except Exception as error:
            self._fail(error)
        except BaseException as error:
            self._fail(error)
            leave = error
        self._finish()
        if leave is not None:
            raise leave
        assert self.outcome is not None
        return self.outcome

    def _finish(self) -> None:
        if self.blackout is not None and not self.blackout.safe:
            self._fail(RuntimeError(f"blackout: {self.blackout.detail}"))
        extra: dict[str, Any] = {"seconds": self.seconds, "error": self.error}
        if self.blackout is not None:
            extra["blackout"] = {"safe": self.blackout.safe, "detail": self.blackout.detail}
        try:
            self._writer.finish(str(self.outcome), extra)
        except OSError as error:  # a full disk: the journal keeps the frames, state has the reason
            self._fail(error)
        self._ended = time.monotonic()
        self._move("finish")

    def _session(self) -> None:
        stage = self.stage
        with ExitStack() as stack:
            frames = FrameWriter(self._writer, QUEUED_STEPS * len(stage.cameras))
            stack.callback(frames.close)
            stack.callback(stage.close)
            # The heartbeat ends before the blackout begins: should that fail, the bank's own
            # watchdog puts the lamps off.
            stack.callback(self._black_out)
            stage.connect()
            check_interlocks(stage)
            stage.lights.set_watchdog(stage.config.watchdog_s)
            stage.trigger.reset()
            cameras = FanOut(stage.cameras)
            stack.callback(cameras.close)
            heartbeat = stack.enter_context(Heartbeat(stage.lights, stage.config.heartbeat_s))
            self._dark()
            for step in self._writer.steps:
                self._boundary()
                wanted = {c for s, c in self._wanted(step)}
                if wanted:
                    heartbeat.check()
                    self._shoot(step, wanted, cameras, frames)
                self.steps_done += 1
                self._notify("capture.step", {"steps_done": self.steps_done, **step.to_dict()})
            cameras(self._drain)
            cameras(lambda camera: camera.disarm())

    def _wanted(self, step: Step) -> list[tuple[int, str]]:
        keys = [(step.index, c.name) for c in self.stage.cameras]
        records = self._writer.records
        return [k for k in keys if k not in records or records[k].file is None]

    def _shoot(self, step: Step, wanted: set[str], cameras: FanOut, frames: FrameWriter) -> None:
        """One step; cameras without a frame get more pulses, only their frames are kept then."""
        for attempt in range(self._retries + 1):
            if attempt or self._armed != step.exposure:
                self._arm(step.exposure, cameras)
            pulse = self._expose(step)
            shot = cameras(lambda camera: camera.read(self._cancel))
            for camera in self.stage.cameras:
                frame = shot[camera.name]
                self._account(camera, frame)
                if frame is not None and camera.name in wanted:
                    frames.put(Shot(step, camera.name, frame, camera.info, pulse, attempt))
                    wanted.discard(camera.name)
            if not wanted:
                return
            again = attempt < self._retries
            lost = {"step": step.index, "cameras": sorted(wanted), "attempt": attempt}
            self._notify("capture.frame_missing", {**lost, "shot_again": again})
        for name in sorted(wanted):
            reason = f"no frame from the camera after {self._retries + 1} pulses"
            self._writer.record_missing(
                step, name, reason=reason, pulse=pulse, attempt=self._retries
            )

    def _account(self, camera: Camera, frame: Frame | None) -> None:
        if frame is None:
            self._accounts[camera.name].missed()
        else:
            self._accounts[camera.name].arrived(frame.block_id)

    def _arm(self, exposure: float, cameras: FanOut) -> None:
        """Arm every camera; all have confirmed when this returns. What a queue still holds is
        looked at first, because arming drops it."""
        if self._armed is not None:
            cameras(self._drain)
        self._armed = None
        cameras(lambda camera: camera.arm(exposure))
        self._armed = exposure

    def _drain(self, camera: Camera) -> None:
        """Drop frames that came late for pulses counted as missed; others raise `IndexShift`."""
        while (frame := camera.read(self._cancel)) is not None:
            self._accounts[camera.name].late(frame.block_id)

    def _expose(self, step: Step) -> int:
        """Light, confirm, settle, pulse, dark; returns the pulse's number."""
        self._sleep(0)
        self._light(step)
        self._sleep(self.stage.config.lights.settle_s)
        self._pulses.fired(self.stage.trigger.pulse(step.exposure))
        # From the box's answer, which never comes before the pulse: the light stays long enough.
        self._sleep(step.exposure)
        self._check_lit(step)
        self._dark(step)
        return self._pulses.count

    def _check_lit(self, step: Step) -> None:
        """Raise where lamps went off in mid-exposure: the frame would pass for a dark picture."""
        lights = self.stage.lights
        if step.kind not in ("olat", "all_on") or not lights.capabilities.reads_back:
            return
        lit, expected = lights.status().lit, 1 if step.kind == "olat" else lights.count
        if lit != expected:
            raise DeviceError(
                lights.name,
                f"looking after the exposure of step {step.index}",
                expected=f"{expected} lamps lit",
                received=f"{lit} lit",
                todo="Watchdog, interlock or emergency stop put them off: clear the cause.",
            )

    def _sleep(self, seconds: float) -> None:
        if self._cancel.wait(max(0.0, seconds)):
            raise Cancelled("the capture is being stopped")

    def _light(self, step: Step) -> None:
        lights = self.stage.lights
        if step.kind in ("olat", "all_on"):
            lights.set_level(step.level)
        if step.light is not None:
            lights.select(self._lamp[step.light])
        elif step.kind == "all_on":
            lights.all_on()
        elif step.kind == "dark":
            self._dark()
        else:
            self._project(step)

    def _project(self, step: Step) -> None:
        projectors = self.stage.projectors
        if projectors is None:
            raise RuntimeError(f"step {step.index} ({step.kind}): the stage has no projectors")
        if step.kind == "tracking":
            projectors.all_on(step.level)
        else:
            assert step.projector is not None
            assert step.row is not None
            projectors.line(step.projector, step.row, step.level)

    def _dark(self, step: Step | None = None) -> None:
        """Put off what the step lit; without a step, everything."""
        if step is None or step.kind in ("olat", "all_on"):
            self.stage.lights.off()
        projected = step is None or step.kind in ("scanline", "tracking")
        if projected and self.stage.projectors is not None:
            self.stage.projectors.off()

    def _boundary(self) -> None:
        """Where pause and abort take effect."""
        if self._abort_asked:
            raise Cancelled("aborted")
        if not self._pause_asked:
            return
        self._move("pause")
        dark = blackout(self.stage)
        if not dark.safe:
            raise RuntimeError(f"pausing: {dark.detail}")
        with self._changed:
            self._changed.wait_for(lambda: self._abort_asked or not self._pause_asked)
        if self._abort_asked:
            raise Cancelled("aborted while paused")
        check_interlocks(self.stage)
        self._move("resume")

    def _black_out(self) -> None:
        self.blackout = blackout(self.stage)

    def _require(self, action: str) -> None:
        if not self._machine.allows(action) or (self._abort_asked and action != "abort"):
            raise WrongState(action, self.state)

    def _fail(self, error: BaseException) -> None:
        text = str(error) or type(error).__name__
        self.error = text if self.error is None else f"{self.error}; {text}"
        self._move("fail")

    def _move(self, action: str) -> None:
        with self._changed:
            self._machine.do(action)
            self._changed.notify_all()
        state = {"state": self.state, "outcome": self.outcome, "error": self.error}
        self._notify("capture.state", state)

"""Runs a plan's steps over a stage: expose, read, account, write; dark at every end."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any

from reconstruction import Capture, CaptureWriter, Step
from stage_service.acquisition.exposing import Exposing
from stage_service.acquisition.frame_intake import FrameIntake
from stage_service.acquisition.frame_queue import FrameWriter, Shot, queued_frames
from stage_service.acquisition.hardware_run import HardwareRun
from stage_service.acquisition.progress import RunProgress
from stage_service.acquisition.safety import Blackout, blackout, check_interlocks
from stage_service.acquisition.sentinels import check_sentinels
from stage_service.acquisition.states import CannotPause, Machine, Outcome, State, WrongState
from stage_service.acquisition.timings import Timings
from stage_service.devices.cameras.fan_out import FanOut
from stage_service.devices.device_set import DeviceSet
from stage_service.devices.errors import Cancelled, DeviceError
from stage_service.devices.heartbeat import Heartbeat
from stage_service.devices.permission import NotPermitted, Permission
from stage_service.plan.resolved import ResolvedPlan
from stage_service.plan.stepping import SHORTEST_RUN

Notify = Callable[[str, dict[str, Any]], None]
OWN_BLACKOUT_S = 0.5
"""`darken` waits this long for the run's own final blackout."""
WHILE_PAUSED = "Remove the cause first: until then resuming fails the capture; its frames are kept."
MAY_BE_ANOTHER = "the camera held one frame too many: this frame may show another step"


class Sequencer:
    """One run over the frames that a capture still lacks. `run` blocks; the other methods may be
    called from any thread.

    Everything is lit under `permission`: abort, blackout, a standstill of the service and the end
    of the run revoke it, a pause suspends it. `watch` is called before the service lights a step
    and raises what forbids it. `notify(kind, data)` receives "capture.state", "capture.progress",
    "capture.step" and "capture.frame_missing". However the run ends, lamps and projectors are put
    off and read back.
    """

    def __init__(
        self,
        devices: DeviceSet,
        writer: CaptureWriter,
        plan: ResolvedPlan,
        *,
        permission: Permission,
        watch: Callable[[Step], None] | None = None,
        notify: Notify = lambda _kind, _data: None,
    ) -> None:
        self.devices = devices
        self.error: str | None = None
        self.trouble: str | None = None  # devices that fail while the run is paused
        self.faults: list[str] = []  # the names of devices that failed
        self.blackout: Blackout | None = None
        self.steps_done = 0
        shot = Counter(camera for (_, camera), r in writer.records.items() if r.file is not None)
        self.progress = RunProgress(
            writer.steps,
            {c.name: shot[c.name] for c in devices.cameras},
            lambda now: self._notify("capture.progress", now.model_dump(mode="json")),
        )
        self._began: float | None = None
        self._ended: float | None = None
        self._writer, self._permission = writer, permission
        self._retries, self._runs, self._rate_hz = plan.retries, plan.runs, plan.plan.rate_hz
        self._notify = notify
        self._machine = Machine()
        self._changed = threading.Condition()
        self._pause_requested = self._abort_requested = False
        self._cancel = threading.Event()
        self._dark = threading.Event()
        self._lamp = {light.name: i for i, light in enumerate(writer.rig.lights)}
        self._clocked = 0  # steps of the hardware-stepped run that is under way
        self._unclear: dict[str, str] = {}
        self._timings = Timings()
        self._exposing = Exposing(
            devices, plan.lamp_levels, self._cancel, self._timings, self._rate_hz, watch
        )
        self._intake = FrameIntake(devices, self.progress, self._timings, self._cancel)
        self.by_device = self._intake.by_device

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
        """Seconds since the start, until the end; None before the start."""
        if self._began is None:
            return None
        return (time.monotonic() if self._ended is None else self._ended) - self._began

    def pause(self) -> None:
        """Pause at the next step boundary, lights off. Raises `WrongState`."""
        with self._changed:
            self._require("pause")
            if self._clocked:
                raise CannotPause(self._clocked)
            self._pause_requested = True
            self._move("pause")

    def resume(self) -> None:
        """Resume, or cancel a pause that has not begun. Raises `WrongState`, and `NotPermitted`
        where the permission was revoked meanwhile."""
        with self._changed:
            self._require("resume")
            if self.state == "paused":
                self._permission.grant()
            self._pause_requested = False
            if self.state == "pausing":
                self._move("resume")
            self._changed.notify_all()

    def abort(self) -> None:
        """Abort at the next step boundary. Raises `WrongState`."""
        with self._changed:
            self._require("abort")
            self._abort_requested = True
            self._permission.revoke("the capture was aborted")
            if self.state != "aborting":
                self._move("abort")
            self._changed.notify_all()

    def stop_now(self) -> None:
        """Abort without waiting for the step's frames; does nothing when the run is over."""
        with self._changed:
            self._abort_requested = True
            self._cancel.set()
            self._permission.revoke("the stage was put dark")
            if self.state != "aborting" and self._machine.allows("abort"):
                self._move("abort")
            self._changed.notify_all()

    def darken(self, within_s: float) -> Blackout:
        """Stop at once and put everything off, whatever the run's thread is stuck in.

        Returns the run's own final blackout if that ends within `OWN_BLACKOUT_S`; otherwise, or if
        the run had ended before this call, the result of a new one on reopened links. Takes at
        most `OWN_BLACKOUT_S + within_s` seconds. Off is sent before this waits for a command that
        is under way.
        """
        over = self._dark.is_set()
        self.stop_now()
        if not over and self._dark.wait(OWN_BLACKOUT_S) and self.blackout is not None:
            return self.blackout
        deadline = time.monotonic() + within_s
        blackout(self.devices, attempts=1, within_s=0.0)  # what hears it goes dark now
        with self._permission.no_light(within_s / 2):
            return blackout(self.devices, within_s=deadline - time.monotonic())

    def run(self) -> Outcome:
        """Shoot what is missing and finish the capture folder; returns the outcome.

        Trouble with a device, the disk or a frame ends in the outcome "failed" and `error`.
        KeyboardInterrupt and SystemExit are raised again after the blackout.
        """
        self._began = time.monotonic()
        leave: BaseException | None = None
        with self._changed:
            if self.state == "idle":  # not aborted yet
                self._move("start")
        try:
            with self._permission.used():
                self._session()
            self._move("complete")
        except (Cancelled, NotPermitted) as error:
            if isinstance(error, Cancelled) or self._abort_requested:
                self._move("stop")
            else:
                self._fail(error)
        except BaseException as error:
            self._fail(error)
            leave = None if isinstance(error, Exception) else error
        self._finish()
        if leave is not None:
            raise leave
        assert self.outcome is not None
        return self.outcome

    def _finish(self) -> None:
        if self.blackout is not None and self.blackout.blocks:
            self._fail(RuntimeError(f"blackout: {self.blackout.detail}"))
        dark = {} if self.blackout is None else {"blackout": self.blackout.to_dict()}
        extra = {
            "seconds": self.seconds,
            "error": self.error,
            "seconds_by_cause": dict(self._timings.seconds),
            "service_s_per_step_median": self._timings.own_median_s,
            "sentinels_unclear": self._unclear,
            **dark,
        }
        try:
            for camera, steps in self._intake.withdrawn.items():
                for step in steps:
                    self._writer.withdraw(step, camera, reason=MAY_BE_ANOTHER)
            self._writer.finish(str(self.outcome), extra)
        except Exception as error:  # a full disk: the journal keeps the frames
            self._fail(error)
        self._ended = time.monotonic()
        self._move("finish")

    def _session(self) -> None:
        devices = self.devices
        with ExitStack() as stack:
            frames = FrameWriter(self._writer, queued_frames(self._writer.rig))
            stack.callback(frames.close)
            stack.callback(devices.close)
            # The heartbeat ends before the blackout begins: if the blackout fails, the bank's own
            # watchdog switches the lamps off.
            stack.callback(self._black_out)
            devices.connect()
            check_interlocks(devices)
            if any(s.kind in ("scanline", "tracking") for s in self._writer.steps):
                devices.require_power()
            if devices.trigger.table_rows:
                devices.trigger.stop()  # a table that an earlier service left running
            devices.trigger.reset()
            cameras = FanOut(devices.cameras)
            stack.callback(cameras.close)
            lit = (devices.lights, devices.projectors)
            watched = [d for d in lit if d is not None and d.capabilities.dead_man]
            for device in watched:
                device.set_watchdog(devices.config.watchdog_s)
            every = devices.config.heartbeat_s
            beats = [stack.enter_context(Heartbeat(device, every)) for device in watched]
            stack.enter_context(self._permission.lapsing(devices.config.watchdog_s))
            self._exposing.dark()
            for run in self._runs:
                todo = {s: w for s in run.steps if (w := self._wanted(s))}
                self.steps_done += len(run.steps) - len(todo)  # shot before this run
                self.progress.skip(s for s in run.steps if s not in todo)
                if run.stepping == "hardware" and len(todo) >= SHORTEST_RUN:
                    self._boundary(beats)
                    self._clock(todo, cameras, frames)
                for step, wanted in todo.items():
                    self._boundary(beats)
                    if wanted:
                        self.progress.begin(step)
                        with self._timings.step():
                            self._shoot(step, wanted, cameras, frames)
                    self.steps_done += 1
                    self.progress.done(step)
                    self._notify("capture.step", {"steps_done": self.steps_done, **step.to_dict()})
            cameras(self._intake.drain)
            cameras(lambda camera: camera.disarm())
        self._unclear = check_sentinels(Capture(self._writer.path))

    def _wanted(self, step: Step) -> set[str]:
        records = self._writer.records
        shot = ((c.name, records.get((step.index, c.name))) for c in self.devices.cameras)
        return {name for name, record in shot if record is None or record.file is None}

    def _clock(self, todo: dict[Step, set[str]], cameras: FanOut, frames: FrameWriter) -> None:
        """Let the trigger box clock these steps; cameras whose frame arrived leave `todo`."""
        steps, intake, progress = list(todo), self._intake, self.progress
        kept = Counter({camera.name: 0 for camera in self.devices.cameras})
        run = HardwareRun(self.devices, steps, self._lamp, rate_hz=self._rate_hz, progress=progress)
        self._clocked = len(steps)
        progress.begin_run(steps)
        try:
            intake.arm(steps[0].exposure, cameras)
            with self._timings.on("hardware run"):
                shots = run.shoot(cameras, self._cancel, lambda: self._abort_requested)
                self._exposing.dark()
        finally:
            self._clocked = 0
        first = intake.pulses.count + 1
        intake.pulses.ran(shots.progress.pulses, self.devices.trigger.count())
        places = intake.place(shots)
        for camera in self.devices.cameras:
            arrived = zip(places[camera.name] or (), shots.frames[camera.name], strict=False)
            for place, frame in arrived:
                # The frame of a pulse beyond the steps that were done was cut short.
                if place >= shots.progress.steps or camera.name not in todo[steps[place]]:
                    continue
                pulse = first + place
                shot = Shot(steps[place], camera.name, frame, camera.info, pulse, attempt=0)
                intake.put(frames, shot)
                kept[camera.name] += 1
                todo[steps[place]].discard(camera.name)
        progress.end_run(kept)
        if shots.error is not None:
            raise shots.error
        if not self._abort_requested:
            for step in steps:
                self._report_missing(step, todo[step], 0)

    def _shoot(self, step: Step, wanted: set[str], cameras: FanOut, frames: FrameWriter) -> None:
        """One step; cameras without a frame get more pulses, of which only theirs are kept."""
        intake = self._intake
        for attempt in range(self._retries + 1):
            if not intake.ready(step.exposure):
                intake.arm(step.exposure, cameras)
            pulse = self._exposing.expose(step, cameras)
            intake.pulses.fired(pulse.count)
            shot = intake.read(cameras)
            for camera in self.devices.cameras:
                frame = shot[camera.name]
                intake.account(camera, frame, pulse)
                if frame is not None and camera.name in wanted:
                    taken = Shot(step, camera.name, frame, camera.info, pulse.count, attempt)
                    intake.put(frames, taken)
                    self.progress.arrived(camera.name)
                    wanted.discard(camera.name)
            if not wanted:
                return
            self._report_missing(step, wanted, attempt)
        given_up = {"pulse": pulse.count, "attempt": self._retries}
        reason = f"no frame from the camera after {self._retries + 1} pulses"
        for name in sorted(wanted):
            self._writer.record_missing(step, name, reason=reason, **given_up)

    def _report_missing(self, step: Step, cameras: set[str], attempt: int) -> None:
        if cameras:
            lost = {"step": step.index, "cameras": sorted(cameras), "attempt": attempt}
            again = attempt < self._retries
            self._intake.count_missing(cameras)
            self.progress.again += len(cameras) * again
            self._notify("capture.frame_missing", {**lost, "shot_again": again})

    def _boundary(self, beats: Sequence[Heartbeat]) -> None:
        """Where pause and abort take effect, and where a failed heartbeat is raised."""
        for beat in beats:
            beat.check()
        if self._abort_requested:
            raise Cancelled("aborted")
        if not self._pause_requested:
            return
        dark = blackout(self.devices)
        if dark.blocks:
            raise RuntimeError(f"pausing: {dark.detail}")
        with self._changed:
            if self.state == "pausing":
                self._permission.suspend("the capture is paused")
                self._move("hold")
            every_s = self.devices.config.heartbeat_s
            while not self._changed.wait_for(self._pause_is_over, every_s):
                self._report_trouble(beats)
            self.trouble = None
        if self._abort_requested:
            raise Cancelled("aborted while paused")
        check_interlocks(self.devices)
        with self._changed:
            if self.state == "paused":
                self._move("resume")

    def _pause_is_over(self) -> bool:
        return self._abort_requested or not self._pause_requested

    def _report_trouble(self, beats: Sequence[Heartbeat]) -> None:
        """Publish when a device fails or recovers during a pause; resuming fails meanwhile."""
        failed = [str(error).rstrip(".") for beat in beats if (error := beat.error)]
        now = f"{'; '.join(failed)}. {WHILE_PAUSED}" if failed else None
        before, self.trouble = self.trouble, now
        if (before is None) != (now is None):
            self._publish_state()

    def _black_out(self) -> None:
        self._permission.revoke("the run is over")
        self.blackout = blackout(self.devices)
        self._dark.set()

    def _require(self, action: str) -> None:
        if not self._machine.allows(action):
            raise WrongState(action, self.state)

    def _fail(self, error: BaseException) -> None:
        all_of = error.exceptions if isinstance(error, BaseExceptionGroup) else (error,)
        for failed in (e for e in all_of if isinstance(e, DeviceError)):
            self.faults.append(failed.device)
            self._intake.count_fault(failed)
        text = str(error) or type(error).__name__
        self.error = text if self.error is None else f"{self.error}; {text}"
        self._move("fail")

    def _move(self, action: str) -> None:
        with self._changed:
            self._machine.do(action)
        self._publish_state()

    def _publish_state(self) -> None:
        state = {"state": self.state, "outcome": self.outcome, "error": self.error or self.trouble}
        self._notify("capture.state", state)

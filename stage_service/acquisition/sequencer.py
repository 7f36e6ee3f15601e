"""Runs a plan's steps over a stage: expose, read, account, write; dark at every end."""

from __future__ import annotations

import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any

from reconstruction import Capture, CaptureWriter, Step
from stage_service.acquisition.accounting import FrameAccount, PulseAccount
from stage_service.acquisition.exposing import Exposing, Pulse
from stage_service.acquisition.frame_queue import FrameWriter, Shot, queued_frames
from stage_service.acquisition.hardware_run import HardwareRun, Shots
from stage_service.acquisition.progress import RunProgress
from stage_service.acquisition.safety import Blackout, blackout, check_interlocks
from stage_service.acquisition.sentinels import check_sentinels
from stage_service.acquisition.states import Machine, Outcome, State, WrongState
from stage_service.acquisition.timings import Timings
from stage_service.devices.cameras.fan_out import FanOut
from stage_service.devices.cameras.interface import CameraDevice, Frame
from stage_service.devices.device_set import DeviceSet
from stage_service.devices.errors import Cancelled, DeviceError, DeviceTimeout, IndexShift
from stage_service.devices.heartbeat import Heartbeat
from stage_service.devices.permission import NotPermitted, Permission
from stage_service.plan.resolved import ResolvedPlan
from stage_service.plan.stepping import SHORTEST_RUN

Notify = Callable[[str, dict[str, Any]], None]
OWN_BLACKOUT_S = 0.5
"""How long whoever darkens a run waits for it to do so itself."""
WHILE_PAUSED = "Remove the cause first: until then resuming fails the capture; its frames are kept."
MAY_BE_ANOTHER = "the camera held a frame too many: this one may have been another step's"


class CannotPause(WrongState):
    """The trigger box clocks these steps; it cannot wait."""

    def __init__(self, steps: int) -> None:
        RuntimeError.__init__(
            self,
            f"cannot pause: the trigger box clocks a run of {steps} steps by itself. Pause after "
            "it, or abort, which stops it at once and keeps the frames of the steps that are done",
        )
        self.action, self.state = "pause", "running"


class Sequencer:
    """One run over the frames that a capture still lacks, so an interrupted one goes on where it
    stopped. `run` blocks; the other methods may be called from any thread.

    `plan` is the writer's. All that the run lights, again after a missed frame, too, it lights by
    `permission`, which abort, blackout, a standstill of the service and the end of the run revoke,
    and which a pause suspends. `watch` is called before the service lights a step, and raises what
    forbids it; what the box clocks keeps to the plan's prediction. `notify(kind, data)` hears
    "capture.state", "capture.progress", "capture.step", "capture.frame_missing". Whatever ends the
    run, lamps and projectors are put off and read back. `progress` is asked by any thread.
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
        self.trouble: str | None = None  # what does not answer while the run is paused
        self.faults: list[str] = []  # the names of devices that failed
        self.by_device: defaultdict[str, Counter[str]] = defaultdict(Counter)
        for camera in devices.cameras:
            self.by_device[camera.name].update(frames=0, missed=0, late=0)
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
        self._pause_asked = False
        self._abort_asked = False
        self._cancel = threading.Event()
        self._dark = threading.Event()
        self._lamp = {light.name: i for i, light in enumerate(writer.rig.lights)}
        self._armed: float | None = None
        self._doubtful = False
        # By camera: frames since its queue was last found empty, and those that it put in doubt.
        self._unchecked: dict[str, list[Step]] = {c.name: [] for c in devices.cameras}
        self._withdrawn: dict[str, list[Step]] = {}
        self._clocked = 0  # steps of the hardware-stepped run that is under way
        self._unclear: dict[str, str] = {}
        self._timings = Timings()
        self._exposing = Exposing(
            devices, self._lamp, self._cancel, self._timings, rate_hz=self._rate_hz, watch=watch
        )
        self._pulses = PulseAccount(devices.trigger.name)
        self._accounts = {
            c.name: FrameAccount(c.name, c.capabilities.block_wrap) for c in devices.cameras
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
            if self._clocked:
                raise CannotPause(self._clocked)
            self._pause_asked = True
            self._move("pause")

    def resume(self) -> None:
        """Go on, or take back a pause that has not begun. Raises `WrongState`, and `NotPermitted`
        where the permission was revoked meanwhile."""
        with self._changed:
            self._require("resume")
            if self.state == "paused":
                self._permission.grant()
            self._pause_asked = False
            if self.state == "pausing":
                self._move("resume")
            self._changed.notify_all()

    def abort(self) -> None:
        """Abort at the next step boundary. Raises `WrongState`."""
        with self._changed:
            self._require("abort")
            self._abort_asked = True
            self._permission.revoke("the capture was aborted")
            if self.state != "aborting":
                self._move("abort")
            self._changed.notify_all()

    def stop_now(self) -> None:
        """Abort without waiting for the step's frames; does nothing when the run is over."""
        with self._changed:
            self._abort_asked = True
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
        KeyboardInterrupt and SystemExit are raised again after everything is in order.
        """
        self._began = time.monotonic()
        leave: BaseException | None = None
        with self._changed:
            if self.state == "idle":  # nobody has asked to abort it yet
                self._move("start")
        try:
            with self._permission.used():
                self._session()
            self._move("complete")
        except (Cancelled, NotPermitted) as error:
            if isinstance(error, Cancelled) or self._abort_asked:
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
        extra: dict[str, Any] = {
            "seconds": self.seconds,
            "error": self.error,
            "seconds_by_cause": dict(self._timings.seconds),
            "service_s_per_step_median": self._timings.own_median_s,
            "sentinels_unclear": self._unclear,
        }
        if self.blackout is not None:
            extra["blackout"] = self.blackout.to_dict()
        try:
            for camera, steps in self._withdrawn.items():
                for step in steps:
                    self._writer.withdraw(step, camera, reason=MAY_BE_ANOTHER)
            self._writer.finish(str(self.outcome), extra)
        except Exception as error:  # a full disk: the journal keeps the frames, state the reason
            self._fail(error)
        self._ended = time.monotonic()
        self._move("finish")

    def _session(self) -> None:
        devices = self.devices
        with ExitStack() as stack:
            frames = FrameWriter(self._writer, queued_frames(self._writer.rig))
            stack.callback(frames.close)
            stack.callback(devices.close)
            # The heartbeat ends before the blackout begins: should that fail, the bank's own
            # watchdog puts the lamps off.
            stack.callback(self._black_out)
            devices.connect()
            check_interlocks(devices)
            if any(s.kind in ("scanline", "tracking") for s in self._writer.steps):
                devices.require_power()
            if devices.trigger.table_rows:
                devices.trigger.stop()  # a table that a service which died has started
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
            cameras(self._drain)
            cameras(lambda camera: camera.disarm())
        self._unclear = check_sentinels(Capture(self._writer.path))

    def _wanted(self, step: Step) -> set[str]:
        records = self._writer.records
        shot = ((c.name, records.get((step.index, c.name))) for c in self.devices.cameras)
        return {name for name, record in shot if record is None or record.file is None}

    def _clock(self, todo: dict[Step, set[str]], cameras: FanOut, frames: FrameWriter) -> None:
        """Let the trigger box clock these steps; what arrived is taken off `todo`'s cameras."""
        steps = list(todo)
        progress, kept = self.progress, Counter(dict.fromkeys(self._accounts, 0))
        run = HardwareRun(self.devices, steps, self._lamp, rate_hz=self._rate_hz, progress=progress)
        self._clocked = len(steps)
        progress.begin_run(steps)
        try:
            with self._timings.on("arm"):
                self._arm(steps[0].exposure, cameras)
            with self._timings.on("hardware run"):
                shots = run.shoot(cameras, self._cancel, lambda: self._abort_asked)
                self._exposing.dark()
        finally:
            self._clocked = 0
        first = self._pulses.count + 1
        self._pulses.ran(shots.progress.pulses, self.devices.trigger.count())
        places = self._place(shots, run)
        for camera in self.devices.cameras:
            arrived = zip(places[camera.name] or (), shots.frames[camera.name], strict=False)
            for place, frame in arrived:
                # The frame of a pulse beyond the steps that were done was cut short.
                if place >= shots.progress.steps or camera.name not in todo[steps[place]]:
                    continue
                pulse = first + place
                shot = Shot(steps[place], camera.name, frame, camera.info, pulse, attempt=0)
                self._put(frames, shot)
                kept[camera.name] += 1
                todo[steps[place]].discard(camera.name)
        progress.end_run(kept)
        self._doubtful = any(todo.values())
        if shots.error is not None:
            raise shots.error
        if not self._abort_asked:
            for step in steps:
                self._tell_missing(step, todo[step], 0)

    def _place(self, shots: Shots, run: HardwareRun) -> dict[str, list[int] | None]:
        schedule = run.schedule[: shots.progress.pulses]
        places = {}
        for name, frames in shots.frames.items():
            ids, times = [f.block_id for f in frames], [f.timestamp for f in frames]
            places[name] = self._accounts[name].place(ids, times, schedule, run.steady)
        return places

    def _shoot(self, step: Step, wanted: set[str], cameras: FanOut, frames: FrameWriter) -> None:
        """One step; cameras without a frame get more pulses, only their frames are kept then."""
        for attempt in range(self._retries + 1):
            if self._doubtful or self._armed != step.exposure:
                with self._timings.on("arm"):
                    self._arm(step.exposure, cameras)
            pulse = self._exposing.expose(step)
            self._pulses.fired(pulse.count)
            with self._timings.on("cameras"):
                shot = cameras(self._read, self.progress.waiting)
            for camera in self.devices.cameras:
                frame = shot[camera.name]
                self._account(camera, frame, pulse)
                if frame is not None and camera.name in wanted:
                    taken = Shot(step, camera.name, frame, camera.info, pulse.count, attempt)
                    self._put(frames, taken)
                    self.progress.arrived(camera.name)
                    wanted.discard(camera.name)
            if not wanted:
                return
            self._tell_missing(step, wanted, attempt)
        given_up = {"pulse": pulse.count, "attempt": self._retries}
        reason = f"no frame from the camera after {self._retries + 1} pulses"
        for name in sorted(wanted):
            self._writer.record_missing(step, name, reason=reason, **given_up)

    def _put(self, frames: FrameWriter, shot: Shot) -> None:
        with self._timings.on("storage"):
            frames.put(shot)
        self._unchecked[shot.camera].append(shot.step)
        self.by_device[shot.camera]["frames"] += 1

    def _tell_missing(self, step: Step, cameras: set[str], attempt: int) -> None:
        if cameras:
            lost = {"step": step.index, "cameras": sorted(cameras), "attempt": attempt}
            again = attempt < self._retries
            for camera in cameras:
                self.by_device[camera]["missed"] += 1
            self.progress.again += len(cameras) * again
            self._notify("capture.frame_missing", {**lost, "shot_again": again})

    def _read(self, camera: CameraDevice) -> Frame | None:
        frame = camera.read(self._cancel)
        self.progress.answered()
        return frame

    def _account(self, camera: CameraDevice, frame: Frame | None, pulse: Pulse) -> None:
        account = self._accounts[camera.name]
        if frame is None:
            # It may still come, and must not pass for the next pulse's.
            self._doubtful = True
            account.missed()
        else:
            account.arrived(frame.block_id, frame.left)
            if camera.capabilities.timestamps and frame.timestamp:
                account.timed(frame.timestamp, pulse.requested, pulse.replied)

    def _arm(self, exposure: float, cameras: FanOut) -> None:
        """Arm every camera; all have confirmed when this returns. What a queue still holds is
        looked at first, because arming drops it."""
        if self._armed is not None:
            cameras(self._drain)
        self._armed = None
        cameras(lambda camera: camera.arm(exposure))
        for account in self._accounts.values():
            account.armed()
        self._armed, self._doubtful = exposure, False

    def _drain(self, camera: CameraDevice) -> None:
        """Drop frames that came late for pulses counted as missed; others raise `IndexShift`, and
        the frames since the last time are taken back: resumed, the capture shoots them again."""
        try:
            while (frame := camera.read(self._cancel)) is not None:
                self._accounts[camera.name].late(frame.block_id)
                self.by_device[camera.name]["late"] += 1
        except IndexShift:
            self._withdrawn[camera.name] = self._unchecked[camera.name]
            raise
        self._unchecked[camera.name] = []

    def _boundary(self, beats: Sequence[Heartbeat]) -> None:
        """Where pause and abort take effect, and failed heartbeats come to light."""
        for beat in beats:
            beat.check()
        if self._abort_asked:
            raise Cancelled("aborted")
        if not self._pause_asked:
            return
        dark = blackout(self.devices)
        if dark.blocks:
            raise RuntimeError(f"pausing: {dark.detail}")
        with self._changed:
            if self.state == "pausing":
                self._permission.suspend("the capture is paused")
                self._move("hold")
            while not self._changed.wait_for(
                lambda: self._abort_asked or not self._pause_asked, self.devices.config.heartbeat_s
            ):
                self._say_trouble(beats)
            self.trouble = None
        if self._abort_asked:
            raise Cancelled("aborted while paused")
        check_interlocks(self.devices)
        with self._changed:
            if self.state == "paused":
                self._move("resume")

    def _say_trouble(self, beats: Sequence[Heartbeat]) -> None:
        """Tell of a device that no longer answers, or answers again; resuming fails meanwhile."""
        failed = [str(error).rstrip(".") for beat in beats if (error := beat.error)]
        now = f"{'; '.join(failed)}. {WHILE_PAUSED}" if failed else None
        told, self.trouble = self.trouble, now
        if (told is None) != (self.trouble is None):
            self._say_state()

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
            theirs = (c.name for c in self.devices.cameras if f" {c.name} " in f" {failed.device} ")
            counts = self.by_device[next(theirs, failed.device)]
            counts["timeouts" if isinstance(failed, DeviceTimeout) else "faults"] += 1
        text = str(error) or type(error).__name__
        self.error = text if self.error is None else f"{self.error}; {text}"
        self._move("fail")

    def _move(self, action: str) -> None:
        with self._changed:
            self._machine.do(action)
        self._say_state()

    def _say_state(self) -> None:
        state = {"state": self.state, "outcome": self.outcome, "error": self.error or self.trouble}
        self._notify("capture.state", state)

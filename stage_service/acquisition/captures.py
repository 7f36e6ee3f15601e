"""The captures of one stage: start, steer, list. The only seam that the API's routes call."""

from __future__ import annotations

import secrets
import shutil
import threading
from collections.abc import Callable
from contextlib import closing, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from reconstruction import Capture, CaptureWriter, Mesh
from reconstruction.arrays import Bools
from reconstruction.capture.writer import utc_now
from reconstruction.files.durable import RESERVE
from stage_service.acquisition.capture_run import CaptureRun, plan_of
from stage_service.acquisition.latch import Latch
from stage_service.acquisition.safety import Blackout, blackout, off_on_exit
from stage_service.acquisition.states import CaptureStatus, WrongState, possible, read_status
from stage_service.config import RigFile
from stage_service.devices.device_set import DeviceSet
from stage_service.devices.lights.limited import LitTimes
from stage_service.plan.capture_plan import CapturePlan
from stage_service.plan.flash import SLOW_HZ, FlashRefusal
from stage_service.plan.resolved import PlanError, ResolvedPlan, resolve
from stage_service.records.audit import SERVICE, AuditLog
from stage_service.records.events import EventLog
from stage_service.records.lease import RootLock

STOP_WITHIN_S = 30.0
"""A capture that is stopped at once is out of its last device call within this time."""


class Busy(RuntimeError):
    """Another capture is running; the stage makes one at a time."""

    def __init__(self, running: str) -> None:
        super().__init__(f"capture {running} is running; wait for it, or abort it first")
        self.running = running


class UnknownCapture(LookupError):
    """No capture has this id."""

    def __init__(self, capture_id: str) -> None:
        super().__init__(f"there is no capture {capture_id!r}; GET /captures lists those there are")


class CaptureManager:
    """Makes captures under `root/captures/<id>`, one at a time, each on a thread of its own.

    `on_complete(status)` is called on that thread when a capture is done with outcome "completed".
    Folders without a manifest found at the start are listed as interrupted. Constructing connects
    to nothing; `start`, `devices`, `blackout` and `darken` talk to the stage. Raises `RootInUse`
    while another manager has this root.

    A blackout that could not be verified is latched (`latch`): nothing is lit until that is over.
    `audit` is where the captures' ends and the latch are recorded.
    """

    def __init__(
        self,
        rig_file: RigFile,
        root: Path,
        on_complete: Callable[[CaptureStatus], object] | None = None,
    ) -> None:
        self.rig_file = rig_file
        self.folder = root / "captures"
        self.folder.mkdir(parents=True, exist_ok=True)
        self._root_lock = RootLock(root)
        self.audit = AuditLog(root / "audit.jsonl")
        self.latch = Latch(root / "unsafe.json")
        self._dark: Blackout | None = None
        self.events = EventLog()
        self._on_complete = on_complete
        self._lock = threading.RLock()
        self._talking = threading.Lock()
        self._running: CaptureRun | None = None
        self._closed = self._darkening = False
        self._lit: LitTimes = {}
        self._done: dict[str, CaptureStatus] = {}
        for plan in sorted(self.folder.glob("*/plan.json")):
            # a folder that is no capture, or a damaged one, must not keep the service from starting
            with suppress(ValueError, LookupError, OSError):
                self._done[plan.parent.name] = read_status(plan.parent)
        self._stay_on_exit = off_on_exit(self.close)

    def start(
        self,
        plan: CapturePlan,
        *,
        masks: dict[str, Bools] | None = None,
        head: Mesh | None = None,
        extra: dict[str, Any] | None = None,
        armed_by: str | None = None,
    ) -> str:
        """Validate, create the folder, begin on a thread; returns the capture's id at once.

        `extra` is kept in `plan.json` and shown as `CaptureStatus.request`; `armed_by` says who at
        the stage answers for flashes that the plan has consent for. Raises `Busy`, `Unsafe`,
        `FlashRefusal`; `PlanError` and `CaptureError` (masks) before any device is touched.
        Trouble with devices appears as outcome "failed" with `error`.
        """
        resolved = resolve(plan, self.rig_file)
        cost = resolved.cost
        _check_flashing(resolved, armed_by)
        free = shutil.disk_usage(self.folder).free
        if cost.bytes + RESERVE > free:
            need, have = f"{cost.bytes / 1e9:.1f} GB", f"{free / 1e9:.1f} GB"
            raise PlanError([f"the plan writes {need}, {self.folder} has {have} free"])
        with self._lock:
            self._check_free()
            now = datetime.now(UTC)
            capture_id = f"{now:%Y%m%d-%H%M%S}-{secrets.token_hex(2)}"
            description = {
                "steps": list(resolved.steps),
                "plan": plan.model_dump(mode="json"),
                "cost": cost.model_dump(mode="json"),
                "started": utc_now(),
                "armed_by": armed_by,
                "request": extra or {},
            }
            devices = self._devices()
            writer = CaptureWriter.create(
                self.folder / capture_id, self.rig_file.rig, description, masks=masks, head=head
            )
            self._begin(capture_id, resolved, devices, writer, armed_by)
        return capture_id

    def _continue(self, capture_id: str, armed_by: str | None) -> None:
        """Shoot what a capture lacks that is done and did not complete."""
        with self._lock:
            done = self.get(capture_id)
            if "continue" not in possible(done.state, done.outcome):
                raise WrongState("resume", done.state, done.outcome)
            self._check_free()
            path = Path(done.path)
            plan = plan_of(Capture(path), self.rig_file)
            _check_flashing(plan, armed_by)
            devices = self._devices()
            self._begin(capture_id, plan, devices, CaptureWriter.reopen(path), armed_by)
            del self._done[capture_id]

    def _check_free(self) -> None:
        if self._closed:
            raise Busy("none, but the service is closing")
        if self._darkening:
            raise Busy("none, but the stage is being put dark")
        if self._running is not None:
            raise Busy(self._running.id)
        self.latch.check()

    def _begin(
        self,
        capture_id: str,
        plan: ResolvedPlan,
        devices: DeviceSet,
        writer: CaptureWriter,
        armed_by: str | None,
    ) -> None:
        run = CaptureRun(capture_id, plan, devices, writer, self.events, consented=bool(armed_by))
        name = f"capture-{capture_id}"
        run.thread = threading.Thread(target=self._run, args=(run,), name=name, daemon=True)
        self._running = run
        run.thread.start()

    def get(self, capture_id: str) -> CaptureStatus:
        """What is known about a capture. Raises `UnknownCapture`."""
        with self._lock:
            if self._running is not None and self._running.id == capture_id:
                return self._running.status()
            if capture_id not in self._done:
                raise UnknownCapture(capture_id)
            return self._done[capture_id]

    def list(self) -> list[CaptureStatus]:
        """All captures, oldest first."""
        with self._lock:
            known = list(self._done.values())
            if self._running is not None:
                known.append(self._running.status())
            return sorted(known, key=lambda c: c.id)

    def path(self, capture_id: str) -> Path:
        """The capture's folder. Raises `UnknownCapture`."""
        return Path(self.get(capture_id).path)

    def wait(self, capture_id: str, timeout: float) -> CaptureStatus:
        """Wait until it is done, at most `timeout` seconds; returns the status either way."""
        run = self._running
        if run is not None and run.id == capture_id and run.thread is not None:
            run.thread.join(timeout)
        return self.get(capture_id)

    def pause(self, capture_id: str) -> CaptureStatus:
        """Pause at the next step boundary. Raises `UnknownCapture`, `WrongState`."""
        return self._steer(capture_id, "pause")

    def resume(self, capture_id: str, *, armed_by: str | None = None) -> CaptureStatus:
        """Go on after a pause; of a capture that did not complete, shoot what is missing.

        Raises `UnknownCapture` and `WrongState`; what continues a capture raises as `start` does,
        and `PlanError` where the rig file is no longer that of the capture.
        """
        if self.get(capture_id).state == "done":
            self._continue(capture_id, armed_by)
            return self.get(capture_id)
        return self._steer(capture_id, "resume")

    def abort(self, capture_id: str) -> CaptureStatus:
        """Abort at the next step boundary. Raises `UnknownCapture`, `WrongState`."""
        return self._steer(capture_id, "abort")

    def devices(self) -> dict[str, Any]:
        """Per device kind: {"state": "ok" | "unreachable" | "in use", "error"?: str, figures};
        under "cameras" one such table per camera. Without a capture, connects for the answer.
        "safety" has the state after the last blackout, and whether it is latched."""
        with self._talking:
            run = self._running
            if run is not None:
                lit = {"state": "in use", "detail": f"capture {run.id} runs", "latched": None}
                return {**run.sequencer.devices.status(connect=False), "safety": lit}
            with closing(self._devices()) as devices:
                return {**devices.status(connect=True), "safety": self.darkness()}

    def _devices(self) -> DeviceSet:
        return DeviceSet.of(self.rig_file, self._lit)

    def darkness(self) -> dict[str, Any]:
        """What is known of the lamps when no capture runs: {"state", "detail", "latched"}."""
        last, latched = self._dark or Blackout(False, "no blackout yet"), self.latch.latched
        if latched is not None:
            return {"state": "unknown, unsafe", "detail": latched.detail, "latched": latched.since}
        return {"state": last.state, "detail": last.detail, "latched": None}

    def darken(self) -> None:
        """Put everything off that answers, as the service starts; what does not is latched."""
        if self.rig_file.devices is None:
            return
        with self._talking, closing(self._devices()) as devices:
            self._learn(blackout(devices, attempts=1), devices)

    def blackout(self) -> dict[str, Any]:
        """Put every lamp and projector off and read it back; a running capture ends as aborted.

        Returns {"safe": bool, "state": "dark" | "unknown, unsafe", "detail": str}; what is unknown
        is to be treated as lit.
        """
        with self._lock:
            self._darkening = True  # nothing may begin between the run's end and the blackout
        try:
            run = self._stop()
            with self._talking:
                result = self._darken_after(run)
        finally:
            with self._lock:
                self._darkening = False
        answer = result.to_dict()
        self.events.publish("stage.blackout", answer)
        return answer

    def _darken_after(self, run: CaptureRun | None) -> Blackout:
        """The blackout with which the run has ended, or one of our own."""
        if run is not None and run.sequencer.blackout is not None:
            return run.sequencer.blackout
        with closing(self._devices() if run is None else run.sequencer.devices) as devices:
            result = blackout(devices)
            self._learn(result, devices)
            return result

    def close(self) -> None:
        """Stop what runs, lights off, wait for the thread; the manager starts nothing any more."""
        with self._lock:
            self._closed = True
        run = self._stop()
        if run is not None and run.sequencer.blackout is None:  # its thread is stuck somewhere
            self._learn(blackout(run.sequencer.devices), run.sequencer.devices)
        self._stay_on_exit()
        self._root_lock.release()

    def _stop(self) -> CaptureRun | None:
        """Stop the running capture within its step, and wait until it has ended in order."""
        with self._lock:  # until `start` has started its thread
            run = self._running
        if run is None or run.thread is None:
            return None
        run.sequencer.stop_now()
        run.thread.join(STOP_WITHIN_S)
        return run

    def _steer(self, capture_id: str, action: str) -> CaptureStatus:
        with self._lock:
            status = self.get(capture_id)
            run = self._running
            if run is None or run.id != capture_id:
                raise WrongState(action, status.state)
        getattr(run.sequencer, action)()
        return self.get(capture_id)

    def _run(self, run: CaptureRun) -> None:
        # Not while a short connection of `devices` holds a serial port.
        with self._talking:
            pass
        try:
            run.sequencer.run()
        finally:
            # `devices` may have opened the links once more after the sequencer closed them.
            with self._talking, self._lock:
                try:
                    run.sequencer.devices.close()
                finally:
                    status = self._ended(run)
        if status.outcome == "completed" and self._on_complete is not None:
            try:
                self._on_complete(status)
            except Exception as error:  # the capture is whole; what follows it is told apart
                data = {"id": run.id, "error": f"{type(error).__name__}: {error}"}
                self.events.publish("capture.follow_up_failed", data)

    def _ended(self, run: CaptureRun) -> CaptureStatus:
        """Put the run away; its last blackout is what is known of the stage."""
        self._running = None
        status = run.status()
        self._done[run.id] = status
        if run.sequencer.blackout is not None:
            self._learn(run.sequencer.blackout, run.sequencer.devices)
        result = status.outcome or status.state
        self.audit.record(SERVICE, "capture.end", run.id, result, status.error or "")
        return status

    def _learn(self, result: Blackout, devices: DeviceSet) -> None:
        """Keep what a blackout came to, and latch or unlatch."""
        beams = devices.projectors
        lamps = devices.lights.capabilities.reads_back
        reads_back = lamps and (beams is None or beams.capabilities.reads_back)
        self._dark = result
        change = self.latch.learn(result, reads_back)
        if change is not None:
            self.audit.record(SERVICE, f"latch.{change}", "stage", detail=result.detail)
            self.events.publish("stage.latch", {"latched": change == "set", **result.to_dict()})


def _check_flashing(plan: ResolvedPlan, armed_by: str | None) -> None:
    cost, consent = plan.cost, plan.plan.consent
    if cost.flash.needs_consent and not (consent and armed_by):
        slow = plan.at_rate(SLOW_HZ).cost
        raise FlashRefusal(cost.flash, consent, seconds=cost.seconds, slow_seconds=slow.seconds)

"""The captures of one stage: start, steer, list. The only seam that the API's routes call."""

from __future__ import annotations

import logging
import secrets
import shutil
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from reconstruction import Capture, CaptureWriter, Mesh
from reconstruction.arrays import Bools
from reconstruction.capture.writer import utc_now
from reconstruction.files.durable import RESERVE
from stage_service.acquisition.capture_run import CaptureRun, plan_of
from stage_service.acquisition.catalogue import Catalogue
from stage_service.acquisition.latch import Latch, Unsafe
from stage_service.acquisition.safety import Blackout, blackout, off_on_exit
from stage_service.acquisition.snapshots import APART_S, SNAPSHOT
from stage_service.acquisition.states import (
    OUTCOMES,
    CaptureStatus,
    State,
    WrongState,
    possible,
)
from stage_service.config import RigFile
from stage_service.devices.device_set import DeviceSet
from stage_service.devices.last_seen import LastSeen
from stage_service.devices.ownership import Ownership
from stage_service.plan.capture_plan import CapturePlan
from stage_service.plan.flash import SLOW_HZ, FlashRefusal
from stage_service.plan.resolved import PlanError, ResolvedPlan, resolve
from stage_service.records.audit import SERVICE, AuditLog
from stage_service.records.events import EventLog
from stage_service.records.lease import RootLock
from stage_service.records.logs import about

log = logging.getLogger("hairstage.captures")
T = TypeVar("T")
STOP_WITHIN_S = 30.0
"""A capture that is stopped at once is out of its last device call within this time."""
TIDY_S = 1.0
"""How long a blackout, once it is dark, waits for the capture's folder to be finished."""
ANSWER_S = 5.0
"""A blackout is answered within this time, or three times the slowest timeout_s of the devices."""


class Busy(RuntimeError):
    """Another capture is running; the stage makes one at a time."""

    def __init__(self, running: str) -> None:
        super().__init__(f"capture {running} is running; wait for it, or abort it first")
        self.running = running


class CaptureManager:
    """Makes captures under `root/captures/<id>`, one at a time, each on a thread of its own.

    `on_complete(status)` is called on that thread when a capture is done with outcome "completed".
    What lies there already is in its `catalogue`, without a manifest as interrupted, unreadable as
    damaged. Constructing connects to nothing and reads no capture; `start`, `devices`,
    `blackout` and `darken` talk to the stage, all through one `DeviceSet`. Raises `RootInUse` while
    another manager has this root, `StageInUse` while one on this machine has the stage; `take_over`
    says that one on another machine has it no more.

    A blackout that could not be verified is latched (`latch`): nothing is lit until that is over.
    `audit` is where the captures' ends and the latch are recorded.
    """

    def __init__(
        self,
        rig_file: RigFile,
        root: Path,
        on_complete: Callable[[CaptureStatus], object] | None = None,
        *,
        take_over: bool = False,
    ) -> None:
        self.rig_file = rig_file
        self.folder = root / "captures"
        self.folder.mkdir(parents=True, exist_ok=True)
        self._root_lock = RootLock(root)
        self._ownership = None
        if rig_file.devices is not None:
            try:
                self._ownership = Ownership(rig_file.devices.lights, root, take_over)
            except BaseException:
                self._root_lock.release()
                raise
        self.audit = AuditLog(root / "audit.jsonl")
        self.latch = Latch(root / "unsafe.json")
        self._dark: Blackout | None = None
        self.events = EventLog()
        self._on_complete = on_complete
        self._lock = threading.RLock()  # for moments, never while device or disk is waited for
        self._talking = threading.Lock()  # held by who has connected to the devices to ask them
        self._running: CaptureRun | None = None
        self._preparing: str | None = None
        self._closed = False
        self.blackouts = 0  # begun since the start
        self.ended: CaptureStatus | None = None  # the last run's, once the stage is free
        self._darkening = 0  # under way
        self.catalogue = Catalogue(self.folder, root / "captures.index")
        self._counts: dict[str, Counter[str]] = {
            "captures": Counter(dict.fromkeys(OUTCOMES.values(), 0)),
            "frames": Counter(written=0, missing=0, again=0),
            "device_faults": Counter(),
        }
        self._by_device: defaultdict[str, Counter[str]] = defaultdict(Counter)
        self._looked = -APART_S
        self._stay_on_exit = off_on_exit(self.close)

    @cached_property
    def _devices(self) -> DeviceSet:
        return DeviceSet.of(self.rig_file)

    @cached_property
    def _seen(self) -> LastSeen:
        return LastSeen(self._look, self._devices.unseen())

    def start(
        self,
        plan: CapturePlan,
        *,
        masks: dict[str, Bools] | None = None,
        head: Mesh | None = None,
        extra: dict[str, Any] | None = None,
        armed_by: str | None = None,
        unless_dark_since: int | None = None,
    ) -> str:
        """Validate, create the folder, begin on a thread; returns the capture's id at once.

        `extra` is kept in `plan.json` and shown as `CaptureStatus.request`; `armed_by` says who at
        the stage answers for flashes that the plan has consent for; with `unless_dark_since` it
        begins only if no blackout has begun since `blackouts` was that number. Raises `Busy`,
        `Unsafe`, `FlashRefusal`; `PlanError`, `CaptureError` (masks) before any device is touched.
        Trouble with devices appears as outcome "failed" with `error`.
        """
        resolved = resolve(plan, self.rig_file)
        cost = resolved.cost
        check_flashing(resolved, armed_by)
        free = shutil.disk_usage(self.folder).free
        if cost.bytes + RESERVE > free:
            need, kept, have = (f"{n / 1e9:.2f} GB" for n in (cost.bytes, RESERVE, free))
            told = f"the plan writes {need} and leaves {kept} free, {self.folder} has {have}"
            raise PlanError([told])
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

        def make() -> CaptureRun:
            folder, rig, devices = self.folder / capture_id, self.rig_file.rig, self._devices
            writer = CaptureWriter.create(folder, rig, description, masks=masks, head=head)
            return self._run_of(capture_id, resolved, devices, writer, armed_by)

        self._launch(capture_id, make, unless_dark_since)
        return capture_id

    def snapshot(self, plan: ResolvedPlan) -> CaptureStatus:
        """Shoot the plan as the capture `SNAPSHOT`, in place of the last one; it is in no list, and
        nothing follows it. Raises `Busy`, `Unsafe`."""
        folder = self.folder.parent / SNAPSHOT
        cost = plan.cost.model_dump(mode="json")
        told = {"steps": list(plan.steps), "cost": cost, "started": utc_now()}

        def make() -> CaptureRun:
            time.sleep(max(0.0, self._looked + APART_S - time.monotonic()))
            self._looked = time.monotonic()
            self.catalogue.take(SNAPSHOT)
            shutil.rmtree(folder, ignore_errors=True)
            writer = CaptureWriter.create(folder, self.rig_file.rig, told)
            return self._run_of(SNAPSHOT, plan, self._devices, writer, None)

        self._launch(SNAPSHOT, make)
        return self.get(SNAPSHOT)

    def _continue(self, capture_id: str, armed_by: str | None) -> None:
        """Shoot what a capture lacks that is done and did not complete."""
        done = self.get(capture_id)
        if "continue" not in possible(done.state, done.outcome):
            raise WrongState("resume", done.state, done.outcome)

        def make() -> CaptureRun:
            path = Path(done.path)
            plan = plan_of(Capture(path), self.rig_file)
            check_flashing(plan, armed_by)
            devices = self._devices
            return self._run_of(capture_id, plan, devices, CaptureWriter.reopen(path), armed_by)

        self._launch(capture_id, make)

    def _run_of(
        self,
        capture_id: str,
        plan: ResolvedPlan,
        devices: DeviceSet,
        writer: CaptureWriter,
        armed_by: str | None,
    ) -> CaptureRun:
        consented = bool(armed_by)
        run = CaptureRun(capture_id, plan, devices, writer, self.events, consented=consented)
        name = f"capture-{capture_id}"
        run.thread = threading.Thread(target=self._run, args=(run,), name=name, daemon=True)
        return run

    def _launch(
        self, capture_id: str, make: Callable[[], CaptureRun], since: int | None = None
    ) -> None:
        """Begin what `make` prepares in the disk's own time, unless a blackout comes meanwhile."""
        with self._lock:
            self._check_free()
            blackouts = self.blackouts if since is None else since
            self._preparing = capture_id
        run = None
        try:
            self.take_stage()  # the bank may have been switched off, and its owner forgotten
            run = make()
            with self._lock:
                if self._closed or self.blackouts != blackouts:
                    raise Busy("none, but the stage was put dark meanwhile")
                self.catalogue.take(capture_id)
                self._running = run
                assert run.thread is not None
                run.thread.start()
        except BaseException:
            if run is not None:
                run.give_up()
                if capture_id != SNAPSHOT:
                    self.catalogue.adopt(capture_id)
            raise
        finally:
            with self._lock:
                self._preparing = None

    def _check_free(self) -> None:
        if self._closed:
            raise Busy("none, but the service is closing")
        if self._darkening:
            raise Busy("none, but the stage is being put dark")
        going = self._preparing if self._running is None else self._running.id
        if going is not None:
            raise Busy(going)
        self.latch.check()

    @property
    def running(self) -> str | None:
        """The id of the capture that is being made; asks neither disk nor device."""
        run = self._running
        return None if run is None else run.id

    @property
    def running_state(self) -> State:
        """Where the capture is that is being made; "idle" where there is none."""
        run = self._running
        return "idle" if run is None else _not_yet_over(run.status()).state

    def counts(self) -> dict[str, dict[str, float]]:
        """Since the start: captures by how they ended, frames by what became of them, faults by
        device. Asks neither disk nor device."""
        with self._lock:
            frames = self._counts["frames"].copy()
            if self._running is not None:
                frames.update(self._running.frames())
            return {**{k: dict(v) for k, v in self._counts.items()}, "frames": dict(frames)}

    def _since_start(self, device: str) -> dict[str, int]:
        with self._lock:
            counts = Counter(timeouts=0, faults=0)
            counts.update(self._by_device[device])
            if self._running is not None:
                counts.update(dict(self._running.sequencer.by_device.get(device, {})))
            return dict(counts)

    def devices_seen(self) -> dict[str, str]:
        """Each device's state when it was last asked, by kind or a camera's name; asks nobody."""
        if self.rig_file.devices is None:
            return {}
        seen = self._seen.peek()
        named = {**seen.pop("cameras", {}), **seen}
        return {k: v["state"] for k, v in named.items() if isinstance(v, dict) and "state" in v}

    def get(self, capture_id: str) -> CaptureStatus:
        """What is known about a capture. Raises `UnknownCapture`."""
        self.catalogue.read(capture_id)
        with self._lock:
            if self._running is not None and self._running.id == capture_id:
                return _not_yet_over(self._running.status())
            return self.catalogue.get(capture_id)

    def list(self) -> list[CaptureStatus]:
        """All captures that the catalogue has read, oldest first."""
        self.catalogue.read_all()
        with self._lock:
            known = self.catalogue.list()
            if self._running is not None:
                known.append(_not_yet_over(self._running.status()))
            return sorted((c for c in known if c.id != SNAPSHOT), key=lambda c: c.id)

    def path(self, capture_id: str) -> Path:
        """The capture's folder. Raises `UnknownCapture`."""
        return Path(self.get(capture_id).path)

    def check_idle(self, capture_id: str) -> None:
        """Raise `WrongState` while it is shot, `UnknownCapture` where there is none."""
        with self._lock:
            going = self._preparing if self._running is None else self._running.id
            if capture_id == going:
                raise WrongState("remove", self.get(capture_id).state)
            self.get(capture_id)

    def set_aside(self, capture_id: str, move: Callable[[Path], T]) -> T:
        """`move(folder)`, after which there is no such capture. Raises as `check_idle`."""
        with self._lock:
            self.check_idle(capture_id)
            status = self.get(capture_id)
            self.catalogue.take(capture_id)
        try:
            return move(Path(status.path))
        except BaseException:
            self.catalogue.put(status)
            raise

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
        under "cameras" one such table per camera. They are asked anew, but not waited for: "age_s"
        is how old the answer is. "safety" has the state after the last blackout, and whether it is
        latched. "since_start" counts what a device did to captures since the service started:
        "faults" and "timeouts" ended one; a camera "missed" frames, and was "late" with some."""
        no_stage = self.rig_file.devices is None
        seen: dict[str, Any] = {"age_s": None} if no_stage else self._seen.get()
        cameras = {
            name: {**entry, "since_start": self._since_start(name)}
            for name, entry in seen.get("cameras", {}).items()
        }
        for kind, entry in seen.items():
            if isinstance(entry, dict) and "name" in entry:
                seen[kind] = {**entry, "since_start": self._since_start(entry["name"])}
        return {**seen, **({"cameras": cameras} if cameras else {}), "safety": self.safety()}

    def waits_for(self) -> str | None:
        """What keeps a capture from beginning that nobody stands by; None: nothing does."""
        with self._lock:
            try:
                self._check_free()
            except (Busy, Unsafe) as error:
                return str(error)
            if self._dark is None or self._dark.blocks:
                return "nobody knows yet whether the stage is dark"
        return None

    def safety(self) -> dict[str, Any]:
        """What is known of the lamps now: {"state", "detail", "latched"}."""
        run = self._running
        if run is None:
            return self.darkness()
        return {"state": "in use", "detail": f"capture {run.id} runs", "latched": None}

    def _look(self) -> dict[str, Any] | None:
        """Ask the devices; without a capture, connect for the answer, until one begins."""
        devices = self._devices
        with self._talking:
            if self._running is not None:
                return devices.status(connect=False)
            try:
                return devices.status(connect=True, given_up=lambda: self._running is not None)
            finally:
                devices.close()

    def darkness(self) -> dict[str, Any]:
        """What is known of the lamps when no capture runs: {"state", "detail", "latched"}."""
        last, latched = self._dark or Blackout(False, "no blackout yet"), self.latch.latched
        if latched is not None:
            return {"state": "unknown, unsafe", "detail": latched.detail, "latched": latched.since}
        return {"state": last.state, "detail": last.detail, "latched": None}

    def take_stage(self) -> None:
        """Have the stage for this service, before anything is commanded. Raises `StageInUse`."""
        if self._ownership is None:
            return
        with self._talking:
            try:
                self._ownership.claim(self._devices.lights)
            finally:
                self._devices.close()

    def darken(self) -> None:
        """Put everything off that answers, as the service starts; what does not is latched."""
        if self.rig_file.devices is None:
            return
        with self._talking:
            try:
                self._learn(blackout(self._devices, attempts=1))
            finally:
                self._devices.close()

    def blackout(self) -> dict[str, Any]:
        """Put every lamp and projector off and read it back; a running capture ends as aborted.

        Returns {"safe": bool, "state": "dark" | "unknown, unsafe", "detail": str}; what is unknown
        is to be treated as lit. Waits for no disk, no camera and nobody who asks the devices.
        """
        devices = self._devices
        with self._lock:
            self.blackouts += 1
            self._darkening += 1  # nothing may begin until it is over
            run = self._running
        try:
            within_s = max(ANSWER_S, 3 * devices.slowest_s)
            if run is not None:
                result = run.sequencer.darken(within_s)
            else:
                result = blackout(devices, within_s=within_s)
            self._learn(result)
            if run is not None and run.thread is not None:
                run.thread.join(TIDY_S)
        finally:
            with self._lock:
                self._darkening -= 1
                alone = self._darkening == 0 and self._running is None
            if alone:
                devices.close_lit()
        answer = result.to_dict()
        self.events.publish("stage.blackout", answer)
        return answer

    def close(self) -> None:
        """Stop what runs, lights off, wait for the thread; the manager starts nothing any more."""
        with self._lock:
            self._closed = True
            run = self._running
        if run is not None and run.thread is not None:
            result = run.sequencer.darken(STOP_WITHIN_S)
            run.thread.join(STOP_WITHIN_S)
            if run.thread.is_alive():  # it is stuck somewhere
                self._learn(result)
        self._stay_on_exit()
        self.catalogue.close()
        if self._ownership is not None:
            self._ownership.release(self._devices.lights)
        self._root_lock.release()

    def _steer(self, capture_id: str, action: str) -> CaptureStatus:
        with self._lock:
            status = self.get(capture_id)
            run = self._running
            if run is None or run.id != capture_id:
                raise WrongState(action, status.state)
        getattr(run.sequencer, action)()
        return self.get(capture_id)

    def _run(self, run: CaptureRun) -> None:
        with about(capture=run.id):
            self._shoot(run)

    def _shoot(self, run: CaptureRun) -> None:
        # Not while a short connection of `devices` holds a serial port.
        with self._talking:
            pass
        try:
            run.sequencer.run()
        finally:
            # `devices` may have opened the links once more after the sequencer closed them.
            try:
                with self._talking:
                    run.sequencer.devices.close()
            finally:
                self._ended(run)

    def _ended(self, run: CaptureRun) -> None:
        """Put the run away; its last blackout is what is known of the stage."""
        if run.sequencer.blackout is not None:
            self._learn(run.sequencer.blackout)
        status = run.status()
        result = status.outcome or status.state
        kept = run.id != SNAPSHOT
        if kept or result != "completed":
            self.audit.record(SERVICE, "capture.end", run.id, result, status.error or "")
        if kept and status.outcome == "completed" and self._on_complete is not None:
            # Before anybody sees the capture as done: its job is named from then on.
            try:
                self._on_complete(status)
            # Whoever is told, and whatever is wrong there: the capture is whole, and has to end.
            except Exception as error:
                data = {"id": run.id, "error": f"{type(error).__name__}: {error}"}
                self.events.publish("capture.follow_up_failed", data)
        with self._lock:
            if kept:
                self._counts["captures"][result] += 1
                self._counts["frames"].update(run.frames())
            self._counts["device_faults"].update(run.sequencer.faults)
            for device, counts in run.sequencer.by_device.items():
                self._by_device[device].update(counts)
            if kept or result != "completed":
                self.ended = status
            self.catalogue.put(status)
            self._running = None
        self.events.publish("capture.over", {"id": run.id, "outcome": result})

    def _learn(self, result: Blackout) -> None:
        """Keep what a blackout came to, and latch or unlatch."""
        beams = self._devices.projectors
        lamps = self._devices.lights.capabilities.reads_back
        reads_back = lamps and (beams is None or beams.capabilities.reads_back)
        self._dark = result
        change = self.latch.learn(result, reads_back)
        if change is not None:
            self.audit.record(SERVICE, f"latch.{change}", "stage", detail=result.detail)
            self.events.publish("stage.latch", {"latched": change == "set", **result.to_dict()})
        self.events.publish("stage.lamps", self.darkness())


def _not_yet_over(status: CaptureStatus) -> CaptureStatus:
    """The status of a run whose thread still tidies up: nothing else can begin before."""
    if status.state != "done":
        return status
    return status.model_copy(update={"state": "finishing", "outcome": None})


def check_flashing(plan: ResolvedPlan, armed_by: str | None) -> None:
    """Raise `FlashRefusal` where flashes lack consent, or somebody who answers for them."""
    cost, consent = plan.cost, plan.plan.consent
    if cost.flash.needs_consent and not (consent and armed_by):
        slow = plan.at_rate(SLOW_HZ).cost
        raise FlashRefusal(cost.flash, consent, seconds=cost.seconds, slow_seconds=slow.seconds)

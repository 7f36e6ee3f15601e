"""The captures of one stage: start, steer, list."""

from __future__ import annotations

import logging
import shutil
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from reconstruction import Capture, CaptureWriter, Mesh
from reconstruction.arrays import Bools
from reconstruction.capture.writer import utc_now
from reconstruction.files.durable import write_whole
from reconstruction.reading import printable
from stage_service.acquisition.safety import blackout, off_on_exit
from stage_service.acquisition.states import (
    CaptureStatus,
    State,
    WrongState,
    possible,
    read_status,
)
from stage_service.captures.capture_run import CaptureRun, Tally, plan_of
from stage_service.captures.catalogue import Catalogue
from stage_service.captures.hold import STARTED, Hold
from stage_service.captures.may_light import Facts, Moment, Word, check
from stage_service.captures.snapshots import APART_S, SNAPSHOT
from stage_service.captures.stage import Stage, unknown
from stage_service.config import RigFile
from stage_service.devices.device_set import DeviceSet
from stage_service.plan.capture_plan import CapturePlan
from stage_service.plan.flash import FlashRefusal
from stage_service.plan.resolved import ResolvedPlan, resolve
from stage_service.records.audit import SERVICE, AuditLog
from stage_service.records.clock import boot_seconds
from stage_service.records.events import EventLog
from stage_service.records.lease import Leases, RootLock
from stage_service.records.logs import about

log = logging.getLogger("hairstage.captures")
T = TypeVar("T")
STOP_WITHIN_S = 3.0
"""The end of the service waits for so long until a capture that runs is read back dark."""
TIDY_S = 1.0
"""How long a blackout, once it is dark, waits for the capture's folder to be finished."""
GIVEN_UP_S = 5.0
"""A blackout is over within this time, or three times the slowest timeout_s of the devices."""
LATE_AFTER_S = 1.0
"""What has not been read back dark by then is told as unknown, before the blackout is answered."""
UNREAD = "a blackout is under way: not every lamp and projector has been read back dark yet"


class CaptureManager:
    """Makes captures under `root/captures/<id>`, one at a time, each on a thread of its own.

    `on_complete(status)` is called on that thread when a capture is done with outcome "completed".
    What lies there already is in its `catalogue`, without a manifest as interrupted, unreadable as
    damaged. Constructing connects to nothing and reads no capture but the snapshot; `start`,
    `devices`, `blackout` and `darken` talk to the stage, all through one `DeviceSet`. Raises
    `RootInUse` while another manager has this root, `StageInUse` while one on this machine has the
    stage; `take_over` says that one on another machine has it no more.

    A blackout that could not be verified is latched (`latch`): nothing is lit until that is over.
    `audit` is where the captures' ends and the latch are recorded. Every way to a lamp goes through
    `may_light`, with what is known here, the `leases` and the queue's `hold`.
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
        self.audit, self.events = AuditLog(root / "audit.jsonl"), EventLog()
        self.hold = Hold(self.events, _started(self._root_lock.left_by))
        self._lock = threading.RLock()  # for moments, never while device or disk is waited for
        self._running: CaptureRun | None = None
        self._revocations = 0
        try:
            self.leases = Leases(root / "lease.json")
            self.stage = Stage(
                rig_file,
                root,
                self.audit,
                self.events,
                lambda: self._running is not None,
                self._revoke,
                take_over=take_over,
            )
        except BaseException:
            self._root_lock.release()
            raise
        self._on_complete = on_complete
        self._preparing: str | None = None
        self._closed = False
        self._darkening = 0  # under way
        self._unread = 0  # of these, those whose devices have not all answered
        self._shooting = root / "shooting"  # names the capture under way
        self.died_in = _text(self._shooting)  # in which a service ended, until the next
        self.catalogue = Catalogue(self.folder, root / "captures.index")
        if (root / SNAPSHOT).is_dir():
            self.catalogue.put(read_status(root / SNAPSHOT))
        self._tally = Tally()
        self._looked = -APART_S
        self._stay_on_exit = off_on_exit(self.close)

    def start(
        self,
        plan: CapturePlan,
        *,
        masks: dict[str, Bools] | None = None,
        head: Mesh | None = None,
        extra: dict[str, Any] | None = None,
        word: Word | None = None,
    ) -> str:
        """Validate, create the folder, begin on a thread; returns the capture's id at once.

        `extra` is kept in `plan.json` and shown as `CaptureStatus.request`; it begins on `word`,
        without one on that of whoever calls. Raises what `may_light.check` does, `NotRecorded`
        where it cannot be kept who has armed it; `PlanError`, `CaptureError` (masks) before any
        device is touched. Trouble with devices appears as outcome "failed" with `error`.
        """
        word = self._stamped(word or Word())
        resolved = resolve(plan, self.rig_file)
        cost = resolved.cost
        _ = self.stage.devices  # raises where there are none
        self._check(word, resolved)
        resolved.check_room(self.folder)
        now = datetime.now(UTC)
        capture_id = f"{now:%Y%m%d-%H%M%S}-{now.microsecond // 16:04x}"  # sorted by time
        description = {
            "steps": list(resolved.steps),
            "plan": plan.model_dump(mode="json"),
            "cost": cost.model_dump(mode="json"),
            "started": utc_now(),
            "armed_by": word.armed_by,
            "request": extra or {},
        }

        def make(devices: DeviceSet) -> CaptureRun:
            folder, rig = self.folder / capture_id, self.rig_file.rig
            writer = CaptureWriter.create(folder, rig, description, masks=masks, head=head)
            return self._run_of(capture_id, resolved, devices, writer, word)

        self._launch(capture_id, make, word)
        return capture_id

    def snapshot(self, plan: ResolvedPlan, word: Word | None = None) -> CaptureStatus:
        """Shoot the plan as the capture `SNAPSHOT`, in place of the last one; it is in no list, and
        nothing follows it. Raises what `may_light.check` does."""
        word = self._stamped(word or Word("snapshot"))
        folder = self.folder.parent / SNAPSHOT
        cost = plan.cost.model_dump(mode="json")
        told = {"steps": list(plan.steps), "cost": cost, "started": utc_now()}

        def make(devices: DeviceSet) -> CaptureRun:
            time.sleep(max(0.0, self._looked + APART_S - time.monotonic()))
            self._looked = time.monotonic()
            self.catalogue.take(SNAPSHOT)
            shutil.rmtree(folder, ignore_errors=True)
            writer = CaptureWriter.create(folder, self.rig_file.rig, told)
            return self._run_of(SNAPSHOT, plan, devices, writer, word)

        self._launch(SNAPSHOT, make, word)
        return self.get(SNAPSHOT)

    def _continue(self, capture_id: str, word: Word) -> None:
        """Shoot what a capture lacks that is done and did not complete."""
        done = self.get(capture_id)
        if "continue" not in possible(done.state, done.outcome):
            raise WrongState("resume", done.state, done.outcome)

        def make(devices: DeviceSet) -> CaptureRun:
            path = Path(done.path)
            plan = plan_of(Capture(path), self.rig_file)
            self._check(word, plan, capture_id)
            writer = CaptureWriter.reopen(path)
            return self._run_of(capture_id, plan, devices, writer, word)

        self._launch(capture_id, make, word)

    def _run_of(
        self,
        capture_id: str,
        plan: ResolvedPlan,
        devices: DeviceSet,
        writer: CaptureWriter,
        word: Word,
    ) -> CaptureRun:
        armed = word.armed_by is not None
        run = CaptureRun(capture_id, plan, devices, writer, self.events, consented=armed)
        name = f"capture-{capture_id}"
        run.thread = threading.Thread(target=self._run, args=(run,), name=name, daemon=True)
        return run

    def _launch(self, capture_id: str, make: Callable[[DeviceSet], CaptureRun], word: Word) -> None:
        """Begin what `make` prepares in the disk's own time, unless the word counts no more then:
        its permission is granted at the last moment."""
        devices = self.stage.devices  # no folder is made where there are none
        with self._lock:
            self._check(word)
            self._preparing = capture_id
        run = None
        try:
            self.stage.take()  # the bank may have been switched off, and its owner forgotten
            run = make(devices)
            write_whole(self._shooting, f"{capture_id}\n".encode())
            self._record_arming(word, capture_id, run.plan)
            with self._lock:
                self._check(word, run.plan, capture_id)
                assert run.thread is not None
                run.permission.grant()
                self._running = run  # first: its thread may end at once
                try:
                    run.thread.start()
                except RuntimeError:  # none can be had
                    self._running = None
                    raise
                self.catalogue.take(capture_id)
                self.died_in = None
        except BaseException:
            if run is not None:
                self._shooting.unlink(missing_ok=True)
                run.give_up()
                if capture_id != SNAPSHOT:
                    self.catalogue.adopt(capture_id)
            raise
        finally:
            with self._lock:
                self._preparing = None

    def forget_death(self) -> None:
        """Somebody has said that it may go on."""
        with self._lock:
            died, self.died_in = self.died_in, None
        if died is not None and _text(self._shooting) == died:  # not that of another by now
            self._shooting.unlink(missing_ok=True)

    def moment(self) -> Moment:
        """Now, as what is asked for from here on has it."""
        return Moment(self._revocations, boot_seconds())

    def _stamped(self, word: Word) -> Word:
        return word if word.given is not None else replace(word, given=self.moment())

    def _check(self, word: Word, plan: ResolvedPlan | None = None, own: str | None = None) -> None:
        """Raise what the table refuses the word for; `own` is the capture that it is for."""
        flashes, given = None, word.given or self.moment()
        if plan is not None:
            try:
                plan.check_flashing(word.armed_by)
            except FlashRefusal as error:
                flashes = error
        unread = self.catalogue.unread if word.way == "queue" else 0  # may look at the disk
        with self._lock:
            going = self._preparing if self._running is None else self._running.id
            facts = Facts(
                closing=self._closed,
                darkening=self._darkening > 0,
                revoked=given.revocations != self._revocations,
                stale=boot_seconds() - given.at,
                running=None if going == own else going,
                latched=self.stage.latch.latched,
                unknown=not self.stage.known_dark,
                unread=unread,
                leased=self.leases.of_others(word.lease),
                held=self.hold.current,
                flashes=flashes,
            )
        check(word.way, facts)

    def _revoke(self, why: str) -> None:
        """Let nothing be lit any more on a word that was given before."""
        with self._lock:
            self._revocations += 1
            if self._running is not None:
                self._running.permission.revoke(why)

    def _record_arming(self, word: Word, capture_id: str, plan: ResolvedPlan | None) -> None:
        """Have it on the disk who answers for flashes. Raises `NotRecorded`."""
        if word.armed_by is not None:
            consent = None if plan is None else plan.plan.consent
            told = f"armed by {word.armed_by}; consent: {consent or 'as in the plan'}"
            self.audit.require(word.who, "flash.armed", capture_id, told)

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

    def counts(self) -> dict[str, dict[str, int]]:
        """Since the start: captures by how they ended, frames by what became of them, faults by
        device. Asks neither disk nor device."""
        with self._lock:
            return self._tally.counts(self._running)

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

    def resume(self, capture_id: str, word: Word | None = None) -> CaptureStatus:
        """Go on after a pause; of a capture that did not complete, shoot what is missing.

        Raises `UnknownCapture` and `WrongState`; otherwise as `start` does, and `PlanError` where
        the rig file is no longer that of the capture. The word's way is found here.
        """
        word = self._stamped(word or Word())
        if self.get(capture_id).state == "done":
            self._continue(capture_id, replace(word, way="continue"))
            return self.get(capture_id)
        word = replace(word, way="resume")
        self._check(word, own=capture_id)
        self._record_arming(word, capture_id, None)
        with self._lock:
            self._check(word, own=capture_id)
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
        seen = self.stage.query()
        cameras = seen.pop("cameras", {})
        with self._lock:

            def counted(name: str, entry: dict[str, Any]) -> dict[str, Any]:
                return {**entry, "since_start": self._tally.of_device(name, self._running)}

            for kind, entry in seen.items():
                if isinstance(entry, dict) and "name" in entry:
                    seen[kind] = counted(entry["name"], entry)
            if cameras:
                seen["cameras"] = {name: counted(name, entry) for name, entry in cameras.items()}
        return {**seen, "safety": self.safety()}

    def waits_for(self) -> str | None:
        """What keeps a capture from beginning that nobody stands by; None: nothing does."""
        try:
            self._check(Word("queue"))
        except RuntimeError as error:
            return str(error)
        return None

    def not_dark(self) -> str | None:
        """What is not known of the lamps and keeps every capture from beginning; None: nothing.

        Behind a bank that cannot read back, where that is accepted, they may always begin.
        """
        known = self.safety()
        if known["state"] != "unknown, unsafe":
            return None
        return None if known["accepted"] else str(known["detail"])

    def safety(self) -> dict[str, Any]:
        """What is known of the lamps now: {"state", "detail", "latched", "accepted"}."""
        run = self._running
        if self._unread:
            return unknown(UNREAD, self.stage.darkness()["latched"])
        if run is None or self.stage.latch.latched is not None:  # then it is one that hangs
            return self.stage.darkness()
        known = {"state": "in use", "detail": f"capture {run.id} runs"}
        return {**known, "latched": None, "accepted": False}

    def blackout(self) -> dict[str, Any]:
        """Put every lamp and projector off and read it back; a running capture ends as aborted.

        Returns {"safe": bool, "state": "dark" | "unknown, unsafe", "detail": str}; what is unknown
        is to be treated as lit. Waits for no disk, no camera and nobody who asks the devices. Until
        it is over `safety` says "unknown, unsafe", and after `LATE_AFTER_S` an event does.
        """
        devices = self.stage.devices
        with self._lock:
            self._darkening += 1  # nothing may begin until it is over
            self._unread += 1
            run = self._running
            self._revoke("the stage was put dark")
        publish = partial(self.events.publish, "stage.lamps")
        late = threading.Timer(LATE_AFTER_S, lambda: publish(self.safety()))
        late.daemon = True
        try:
            with suppress(RuntimeError):  # no thread can be had: the answer tells
                late.start()
            within_s = max(GIVEN_UP_S, 3 * devices.slowest_s)
            try:
                if run is not None:
                    result = run.sequencer.darken(within_s)
                else:
                    result = blackout(devices, within_s=within_s)
            finally:
                late.cancel()
                if late.ident is not None:
                    late.join()  # what it has to say comes before the answer
                with self._lock:
                    self._unread -= 1
            self.stage.learn(result)
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
            self._revoke("the service is closing")
        if run is not None and run.thread is not None:
            result = run.sequencer.darken(STOP_WITHIN_S)
            run.thread.join(TIDY_S)
            if run.thread.is_alive():  # it is stuck somewhere
                self.stage.learn(result)
            else:  # `darken` may have opened links after the run had closed them
                self.stage.devices.close_lit()
        self._stay_on_exit()
        self.catalogue.close()
        self.stage.release()
        self._root_lock.release()

    def _steer(self, capture_id: str, action: str) -> CaptureStatus:
        with self._lock:
            status = self.get(capture_id)
            run = self._running
            if run is None or run.id != capture_id:
                raise WrongState(action, status.state, status.outcome)
        getattr(run.sequencer, action)()
        return self.get(capture_id)

    def _run(self, run: CaptureRun) -> None:
        with about(capture=run.id):
            self._shoot(run)

    def _shoot(self, run: CaptureRun) -> None:
        self.stage.wait_for_others()
        try:
            run.sequencer.run()
        finally:
            # `devices` may have opened the links once more after the sequencer closed them.
            try:
                with self.stage.alone():
                    pass
            finally:
                self._ended(run)

    def _ended(self, run: CaptureRun) -> None:
        """Put the run away; its last blackout is what is known of the stage."""
        if run.sequencer.blackout is not None:
            self.stage.learn(run.sequencer.blackout)
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
        if result == "completed" or not self._closed:  # else the next service has to know
            with suppress(OSError):  # the disk is gone
                self._shooting.unlink(missing_ok=True)
        with self._lock:
            self._tally.add(run, result if kept else None)
            # Before the stage is free; whoever aborted has held the queue already.
            if result != "completed" and not (result == "aborted" and self.hold.current):
                self.hold.set(f"capture {run.id} {result}{_because(status.error)}")
            self.catalogue.put(status)
            self._running = None
        self.events.publish("capture.over", {"id": run.id, "outcome": result})


def _started(left_by: str | None) -> str:
    """Why the queue is held from the start on."""
    if left_by is None:
        return STARTED
    return f"{STARTED}; the one before it (process {left_by}) was killed or died"


def _because(error: str | None) -> str:
    return f": {error.rstrip('.')}" if error else ""


def _text(path: Path) -> str | None:
    """What a file of one line says; None where there is none."""
    try:
        return printable(path.read_text(errors="replace").strip()) or "of no name"
    except OSError:
        return None


def _not_yet_over(status: CaptureStatus) -> CaptureStatus:
    """The status of a run whose thread still tidies up: nothing else can begin before."""
    if status.state != "done":
        return status
    return status.model_copy(update={"state": "finishing", "outcome": None})

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
from pathlib import Path
from typing import Any, TypeVar

from reconstruction import Capture, CaptureWriter, Mesh
from reconstruction.arrays import Bools
from reconstruction.capture.writer import utc_now
from reconstruction.files.durable import write_whole
from reconstruction.reading import printable
from stage_service.acquisition.safety import off_on_exit
from stage_service.acquisition.states import (
    CaptureStatus,
    WrongState,
    possible,
    read_status,
)
from stage_service.captures.capture_run import CaptureRun, Tally, plan_of
from stage_service.captures.catalogue import Catalogue
from stage_service.captures.light_control import LightControl, while_running
from stage_service.captures.may_light import Word
from stage_service.captures.snapshots import APART_S, SNAPSHOT
from stage_service.config import RigFile
from stage_service.devices.device_set import DeviceSet
from stage_service.plan.capture_plan import CapturePlan
from stage_service.plan.resolved import ResolvedPlan, resolve
from stage_service.records.audit import SERVICE
from stage_service.records.logs import about

log = logging.getLogger("hairstage.captures")
T = TypeVar("T")


class CaptureManager(LightControl):
    """Makes captures under `root/captures/<id>`, one at a time, each on a thread of its own.

    `on_complete(status)` is called on that thread for each capture with outcome "completed".
    Captures already on the disk are in `catalogue`. Constructing connects to no device and reads no
    capture but the snapshot. Raises as `LightControl`.
    """

    def __init__(
        self,
        rig_file: RigFile,
        root: Path,
        on_complete: Callable[[CaptureStatus], object] | None = None,
        *,
        take_over: bool = False,
    ) -> None:
        self.folder = root / "captures"
        self.folder.mkdir(parents=True, exist_ok=True)
        super().__init__(rig_file, root, take_over=take_over)
        self._on_complete = on_complete
        self._shooting = root / "shooting"  # a file with the running capture's id
        self.died_in = _text(self._shooting)  # the capture in which an earlier service died
        self.catalogue = Catalogue(self.folder, root / "captures.index")
        if (root / SNAPSHOT).is_dir():
            self.catalogue.put(read_status(root / SNAPSHOT))
        self._tally = Tally()
        self._last_snapshot = -APART_S  # monotonic seconds
        self._stay_on_exit = off_on_exit(self.close)

    @property
    def unlisted(self) -> int:
        """Captures on the disk that have not been read yet."""
        return self.catalogue.unread

    def start(
        self,
        plan: CapturePlan,
        *,
        masks: dict[str, Bools] | None = None,
        head: Mesh | None = None,
        extra: dict[str, Any] | None = None,
        word: Word | None = None,
    ) -> str:
        """Validate, create the folder, start a thread; returns the capture's id at once.

        `extra` is stored in `plan.json` and shown as `CaptureStatus.request`. Raises as
        `may_light.check`; `NotRecorded` where the arming cannot be recorded; `PlanError` and
        `CaptureError` (masks) before any device is connected. A device's failure appears as
        outcome "failed" with `error`.
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
            **resolved.recorded_patterns,
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
        """Shoot the plan as the capture `SNAPSHOT`, which replaces the last one; it is in no list
        and starts no job. Raises as `may_light.check`."""
        word = self._stamped(word or Word("snapshot"))
        folder = self.folder.parent / SNAPSHOT
        cost = plan.cost.model_dump(mode="json")
        description = {"steps": list(plan.steps), "cost": cost, "started": utc_now()}

        def make(devices: DeviceSet) -> CaptureRun:
            time.sleep(max(0.0, self._last_snapshot + APART_S - time.monotonic()))
            self._last_snapshot = time.monotonic()
            self.catalogue.take(SNAPSHOT)
            shutil.rmtree(folder, ignore_errors=True)
            writer = CaptureWriter.create(folder, self.rig_file.rig, description)
            return self._run_of(SNAPSHOT, plan, devices, writer, word)

        self._launch(SNAPSHOT, make, word)
        return self.get(SNAPSHOT)

    def _continue(self, capture_id: str, word: Word) -> None:
        """Shoot the frames that an ended, incomplete capture lacks."""
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
        """Start the run that `make` prepares. The word is checked again after that, because the
        disk may be slow, and its permission is granted last."""
        devices = self.stage.devices  # raises before a folder is made
        with self._lock:
            self._check(word)
            self._preparing = capture_id
        run = None
        try:
            self.stage.take()  # a bank that was powered off has lost its owner
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
                except RuntimeError:  # no thread available
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
        """Forget the capture in which an earlier service died."""
        with self._lock:
            died, self.died_in = self.died_in, None
        if died is not None and _text(self._shooting) == died:  # not a newer capture's
            self._shooting.unlink(missing_ok=True)

    def _record_arming(self, word: Word, capture_id: str, plan: ResolvedPlan | None) -> None:
        """Record who armed the flashes, on the disk. Raises `NotRecorded`."""
        if word.armed_by is not None:
            consent = None if plan is None else plan.plan.consent
            detail = f"armed by {word.armed_by}; consent: {consent or 'as in the plan'}"
            self.audit.require(word.who, "flash.armed", capture_id, detail)

    def counts(self) -> dict[str, dict[str, int]]:
        """Since the service started: captures by outcome, frames by result, faults by device. Reads
        neither disk nor device."""
        with self._lock:
            return self._tally.counts(self._running)

    def get(self, capture_id: str) -> CaptureStatus:
        """A capture's status. Raises `UnknownCapture`."""
        self.catalogue.read(capture_id)
        with self._lock:
            if self._running is not None and self._running.id == capture_id:
                return while_running(self._running.status())
            return self.catalogue.get(capture_id)

    def list(self) -> list[CaptureStatus]:
        """All captures that the catalogue has read, oldest first."""
        self.catalogue.read_all()
        with self._lock:
            known = self.catalogue.list()
            if self._running is not None:
                known.append(while_running(self._running.status()))
            return sorted((c for c in known if c.id != SNAPSHOT), key=lambda c: c.id)

    def path(self, capture_id: str) -> Path:
        """The capture's folder. Raises `UnknownCapture`."""
        return Path(self.get(capture_id).path)

    def check_idle(self, capture_id: str) -> None:
        """Raise `WrongState` while it is shot, `UnknownCapture` where there is none."""
        with self._lock:
            if capture_id == self._current:
                raise WrongState("remove", self.get(capture_id).state)
            self.get(capture_id)

    def set_aside(self, capture_id: str, move: Callable[[Path], T]) -> T:
        """Call `move(folder)` and take the capture off the list. Raises as `check_idle`."""
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
        """Resume after a pause; for an incomplete capture, shoot the missing frames.

        Raises `UnknownCapture`, `WrongState`, as `start`, and `PlanError` where the rig file has
        changed since the capture. Sets the word's `way`.
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
        """Per device kind: {"state": "ok" | "unreachable" | "in use", "error"?: str, figures},
        under "cameras" one such table per camera, as queried "age_s" seconds ago; starts a new
        query. "safety" is the lamps' state and latch. "since_start" counts since the service
        started: "faults" and "timeouts" that ended a capture, "missed" and "late" frames."""
        found = self.stage.query()
        cameras = found.pop("cameras", {})
        with self._lock:

            def counted(name: str, entry: dict[str, Any]) -> dict[str, Any]:
                return {**entry, "since_start": self._tally.of_device(name, self._running)}

            for kind, entry in found.items():
                if isinstance(entry, dict) and "name" in entry:
                    found[kind] = counted(entry["name"], entry)
            if cameras:
                found["cameras"] = {name: counted(name, entry) for name, entry in cameras.items()}
        return {**found, "safety": self.safety()}

    def close(self) -> None:
        """Stop the running capture, lights off, and start nothing any more."""
        self._stop()
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
            # A status query may have opened links after the sequencer closed them.
            try:
                with self.stage.alone():
                    pass
            finally:
                self._ended(run)

    def _ended(self, run: CaptureRun) -> None:
        """Record and publish the end of a run; its last blackout becomes the stage's state."""
        if run.sequencer.blackout is not None:
            self.stage.learn(run.sequencer.blackout)
        status = run.status()
        result = status.outcome or status.state
        kept = run.id != SNAPSHOT
        if kept or result != "completed":
            self.audit.record(SERVICE, "capture.end", run.id, result, status.error or "")
        if kept and status.outcome == "completed" and self._on_complete is not None:
            # Before the capture is shown as done, so that it is shown with its job.
            try:
                self._on_complete(status)
            except Exception as error:  # any error: the capture is complete and has to end
                data = {"id": run.id, "error": f"{type(error).__name__}: {error}"}
                self.events.publish("capture.follow_up_failed", data)
        if result == "completed" or not self._closed:  # else the next service reads it
            with suppress(OSError):  # the disk is gone
                self._shooting.unlink(missing_ok=True)
        with self._lock:
            self._tally.add(run, result if kept else None)
            # Before the stage is free; an abort by a person has held the queue already.
            if result != "completed" and not (result == "aborted" and self.hold.current):
                self.hold.set(f"capture {run.id} {result}{_because(status.error)}")
            self.catalogue.put(status)
            self._running = None
        self.events.publish("capture.over", {"id": run.id, "outcome": result})


def _because(error: str | None) -> str:
    return f": {error.rstrip('.')}" if error else ""


def _text(path: Path) -> str | None:
    """The text of a file of one line; None if there is none."""
    try:
        return printable(path.read_text(errors="replace").strip()) or "of no name"
    except OSError:
        return None

"""The only interface between the routes and the rest of the service; independent of HTTP."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from reconstruction import CaptureError
from reconstruction.calibration.boards import CalibrationError
from reconstruction.containment import inside, is_file_name
from stage_service.acquisition.states import CaptureStatus, Outcome
from stage_service.calibrating import Calibrating, CalibrationView
from stage_service.captures.catalogue import UnknownCapture
from stage_service.captures.control import Caller, Control
from stage_service.captures.manager import CaptureManager
from stage_service.captures.may_light import Moment
from stage_service.captures.snapshots import SNAPSHOT, one_step
from stage_service.config import RigFile
from stage_service.decoding import Decoder
from stage_service.frames import Frames
from stage_service.inputs import BadInput, check_kept
from stage_service.jobs.follower import JobFollower
from stage_service.jobs.queue import JobQueue, NoSuchJob
from stage_service.leasing import Leasing
from stage_service.links import check_link
from stage_service.plan.capture_plan import CapturePlan
from stage_service.plan.cost import PlanCost
from stage_service.plan.resolved import resolve
from stage_service.preparing import prepare
from stage_service.queueing import Queueing, then
from stage_service.records.audit import Action
from stage_service.records.events import EventLog
from stage_service.records.refusals import Refusals
from stage_service.service_models import (
    AcknowledgeRequest,
    CalibrationRequest,
    CaptureRequest,
    CaptureView,
    Health,
    QueueRequest,
    RigView,
    SnapshotRequest,
)
from stage_service.stopping import NotEnded, Step, end_all
from stage_service.storage import NotThere, Storage
from stage_service.submitting import NotFinished, Submitting
from stage_service.trash import Removed
from stage_service.viewer import RemoteViewing, Source, Tracer
from stage_service.watching import NotReady, Watching

FLUSH_S = 0.5
"""Seconds that the end of the service waits for the audit log's disk."""
LIGHTS_S = 6.0
"""For a capture's end: lamps and projectors read back dark, folder finished, stage released
(`STOP_WITHIN_S`, `TIDY_S`, `RELEASE_S`)."""
OTHERS_S = 3.0
"""For everything else, in parallel."""
READ_S = 1.0
"""Seconds that a start waits for the captures on the disk; the rest is read in the background."""


class Service:
    """The captures, jobs and devices of one root folder.

    `start()` puts the lights off, reads the captures on the disk and follows the jobs; `close()`
    puts the lights off again and may be called repeatedly, from any thread. Steering the stage is
    recorded in the caller's name, and raises `Leased` while another caller holds the lease.
    """

    def __init__(
        self,
        rig_file: RigFile,
        root: Path,
        *,
        take_over: bool = False,
        gpu_workers: bool = False,
    ) -> None:
        self.rig_file, self.root = rig_file, root
        self._captures = CaptureManager(
            rig_file, root, on_complete=self._completed, take_over=take_over
        )
        self._has_stage = False
        self._control = Control(self._captures.audit, self._captures.leases)
        self.queue = Queueing(root / "queue.json", self._captures, self._control, self._prepare)
        self._queue = JobQueue(root, gpu_workers=gpu_workers)
        self._follower = JobFollower(root, self._queue, self._captures.events, self._captures.audit)
        self.jobs = Submitting(
            root / "models", self._control, self._queue, self._follower, self.capture_path
        )
        self.leasing = Leasing(self._control, self.events)
        self.refusals = Refusals(self._captures.audit)
        self.watching = Watching(root, self._captures, self._queue, self._follower)
        self.decoder = Decoder()
        self.storage = Storage(root, self._captures, self._control, self._queue, self.decoder)
        self._tracer = Tracer(lambda: self._captures.running is not None)
        self.viewing = RemoteViewing(
            lambda: [m.name for m in self.storage.models()],
            self._viewed,
            self.decoder,
            self._tracer,
        )
        self.calibrating = Calibrating(root / "calibration", rig_file, self.events, self.decoder)
        self.frames = Frames(self.capture_path, self.decoder, self.calibrating)
        self._closing = threading.Lock()
        self._stopping = self._closed = False
        self.not_ended: list[str] = []  # while it closes, and afterwards

    @property
    def events(self) -> EventLog:
        """The events since the service started."""
        return self._captures.events

    def start(self) -> None:
        """Put the lights off; then, in the background, read the captures on the disk, enqueue jobs
        that a crash left pending, and follow all jobs. The queue starts once all captures are read.

        Raises `StageInUse`, before any command, while another service has the stage.
        """
        if not self._has_stage:
            self.take_stage()
        self._captures.stage.darken()
        self._follower.start()
        self._captures.catalogue.begin(
            self._read, self._all_read, lambda: self._captures.running is not None, READ_S
        )

    def _read(self, status: CaptureStatus) -> None:
        if status.outcome == "completed":
            self._follower.follow_up(status, fresh=False)

    def _all_read(self) -> None:
        known = self._captures.list()
        self.queue.start(known)
        self.events.publish("captures.read", {"count": len(known)})

    def moment(self) -> Moment:
        """The moment of a request: a later blackout overrides it."""
        return self._captures.moment()

    @property
    def unread(self) -> int:
        """Captures on the disk that are not listed yet."""
        return self._captures.unlisted

    @property
    def running(self) -> str | None:
        """The id of the running capture; does not block."""
        return self._captures.running

    def take_stage(self) -> None:
        """Take the stage for this service. Raises `StageInUse`."""
        self._captures.stage.take()
        self._has_stage = True

    def close(self) -> None:
        """Put the lights off, abort the running capture and end everything else, in parallel, each
        within its limit (`LIGHTS_S`, `OTHERS_S`, `FLUSH_S`); `not_ended` lists the rest."""
        self._stopping = True
        with self._closing:
            if self._closed:
                return
            end_all(
                [
                    Step("lamps and capture", self._close_captures, LIGHTS_S),
                    Step("the queue", self.queue.close, OTHERS_S),
                    Step("the calibration", self.calibrating.close, OTHERS_S),
                    Step("the decoder", self.decoder.close, OTHERS_S),
                    Step("the tracer", self._tracer.close, OTHERS_S),
                    Step("the job database", self._close_jobs, OTHERS_S),
                ],
                self.not_ended,
            )
            end_all([Step("the audit log", self._close_audit, FLUSH_S)], self.not_ended)
            self._closed = True

    def _close_captures(self) -> None:
        self._captures.close()
        if (capture := self._captures.running) is not None:
            raise NotEnded(f"capture {capture} hangs: its folder is not finished")

    def _close_jobs(self) -> None:
        self._follower.close()
        self._queue.close()

    def _close_audit(self) -> None:
        self.refusals.close()
        self._control.audit.flush(FLUSH_S)

    def validate(self, plan: CapturePlan) -> PlanCost:
        """The cost of a plan; uses no device. Raises `PlanError`."""
        return resolve(plan, self.rig_file).cost

    def start_capture(self, request: CaptureRequest, by: Caller) -> CaptureView:
        """Start a capture. Raises `BadInput`, `Leased`, as `CaptureManager.start`, and `Forbidden`
        for a pipeline without the scope "jobs" or arming without "arm"."""
        word = self._control.word(by, "capture", request.armed_by)
        if request.pipeline is not None:
            by.require("jobs")
        work = partial(self._prepare(request), word)
        capture = self._control.do(by, "capture.start", work, None, detail=then(request))
        return self.capture(capture)

    def _prepare(self, request: CaptureRequest | QueueRequest) -> Callable[..., str]:
        return prepare(request, self._captures, self.storage, self.decoder)

    def capture(self, capture_id: str) -> CaptureView:
        """A capture's status. Raises `UnknownCapture`."""
        return self._view(self._captures.get(capture_id))

    def captures(
        self, limit: int, offset: int = 0, outcome: Outcome | None = None
    ) -> list[CaptureView]:
        """`limit` captures of that outcome before the `offset` newest; oldest first."""
        known = self._captures.list()
        if outcome is not None:
            known = [status for status in known if status.outcome == outcome]
        end = max(0, len(known) - offset)
        return [self._view(status) for status in known[max(0, end - limit) : end]]

    def snapshot(self, request: SnapshotRequest, by: Caller) -> CaptureView:
        """Start a single exposure as the capture "snapshot", which the next one replaces. Raises
        `PlanError`, `Busy`, `Unsafe`, `Leased`."""
        plan = one_step(self.rig_file, request.light, request.exposure, request.level)
        word, detail = self._control.word(by, "snapshot"), request.light or "all lights"
        work = partial(self._captures.snapshot, plan, word)
        return self._view(self._control.do(by, "snapshot", work, SNAPSHOT, detail=detail))

    def pause(self, capture_id: str, by: Caller) -> CaptureView:
        """Pause at the next step boundary. Raises `UnknownCapture`, `WrongState`, `Leased`."""
        work = partial(self._captures.pause, capture_id)
        return self._view(self._control.do(by, "capture.pause", work, capture_id))

    def resume(self, capture_id: str, by: Caller, armed_by: str | None = None) -> CaptureView:
        """Resume after a pause; for an incomplete capture, shoot the missing frames. Raises
        `Forbidden` for arming without the scope "arm"."""
        word = self._control.word(by, "resume", armed_by)
        work = partial(self._captures.resume, capture_id, word)
        status = self._control.do(by, "capture.resume", work, capture_id)
        return self._view(status)

    def abort(self, capture_id: str, by: Caller) -> CaptureView:
        """Abort at the next step boundary; every caller may. Raises `UnknownCapture`,
        `WrongState`."""

        def work() -> CaptureStatus:
            self._captures.get(capture_id)  # raises before the queue is held
            self.queue.hold(f"abort of capture {capture_id} by {by}")
            return self._captures.abort(capture_id)

        return self._view(self._control.do(by, "capture.abort", work, capture_id, steers=False))

    def _view(self, status: CaptureStatus) -> CaptureView:
        """The status and the capture's job; does not query the database."""
        return CaptureView(**status.model_dump(), job=self._follower.job_after(status.id))

    def _completed(self, status: CaptureStatus) -> None:
        self._follower.follow_up(status)

    def calibrate(self, request: CalibrationRequest, by: Caller) -> CalibrationView:
        """Start a calibration of the rig. Raises `UnknownCapture`, `NotFinished`, `BadInput`."""
        work = partial(self.calibrating.begin, request, self.done_capture)
        what = f"{len(request.boards)} boards, {len(request.diffuse + request.mirror)} spheres"
        try:
            return self._control.do(by, "calibrate", work, "rig", detail=what, steers=False)
        except CalibrationError as error:
            raise BadInput(str(error)) from error

    def calibrated(self) -> Path:
        """The calibrated rig file. Raises `NotThere`."""
        if not self.calibrating.rig.is_file():
            raise NotThere("there is no calibrated rig yet: start a calibration")
        return self.calibrating.rig

    def done_capture(self, capture_id: str) -> Path:
        """The folder of a capture that is not being shot. Raises `UnknownCapture`,
        `NotFinished`."""
        path = self.capture_path(capture_id)
        if self._captures.running == capture_id:
            raise NotFinished(f"capture {capture_id} is being shot")
        return path

    def remove_capture(self, capture_id: str, by: Caller, *, dry_run: bool) -> Removed:
        """Move a capture into the trash. Raises as `Storage.remove_capture`, and `BadInput` for a
        snapshot."""
        check_kept(capture_id)
        pending = self._follower.is_pending
        with self.jobs.lock:
            return self.storage.remove_capture(capture_id, pending, by, dry_run=dry_run)

    def capture_path(self, capture_id: str) -> Path:
        """The capture's folder, also one added by hand or by `import`. Raises `UnknownCapture`,
        `LeadsOutside` for a link."""
        try:
            path = self._captures.path(capture_id)
        except UnknownCapture:
            if not is_file_name(capture_id):
                raise
            path = self.root / "captures" / capture_id
            check_link(f"the capture {capture_id}", path)
            if not (inside(self.root / "captures", capture_id) / "plan.json").is_file():
                raise
            return path.resolve()
        check_link(f"the capture {capture_id}", path)
        return path

    def _viewed(self, name: str) -> Source:
        """The folder of a model for the viewer, with its capture: of the same name, or of its job.
        Raises `NotThere`."""
        model, captures = self.storage.whole_model(name).path, list[Path]()
        with suppress(UnknownCapture, CaptureError):
            captures.append(self.capture_path(name))
        if not captures:
            with suppress(NoSuchJob, CaptureError):
                captures.append(Path(self._queue.get(name).capture))
        return Source(model, tuple(captures))

    def devices(self) -> dict[str, Any]:
        """Each device's status, see `CaptureManager.devices`."""
        return self._captures.devices()

    def blackout(self, by: Caller) -> dict[str, Any]:
        """Put all lamps and projectors off, verified; aborts a running capture. Every caller
        may."""
        self.queue.hold(f"blackout by {by}")
        return self._control.blackout(by, self._captures.blackout)

    def acknowledge(self, request: AcknowledgeRequest, by: Caller) -> dict[str, Any]:
        """Accept a person's word that the lamps are off; holds the queue, because they may still be
        at the stage. Raises `CannotAcknowledge`, `Leased`."""
        stage, said = self._captures.stage, f"{request.name}: {request.note}"

        def work() -> None:
            stage.latch.check_acknowledge()
            self.queue.hold(f"lamps acknowledged as off by {by}")
            stage.acknowledge(said)

        self._control.do(by, "acknowledge", work, detail=said)
        return self._captures.safety()

    def record_login(self, by: Caller, action: str) -> Future[None]:
        """Record a login or logout in the audit log; done once it is on the disk."""
        return self._control.audit.later(str(by), action, "service")

    def audit(self, limit: int) -> list[Action]:
        """The newest actions on the stage, refused ones included; oldest first."""
        return self._control.audit.latest(limit)

    def health(self) -> Health:
        """The state of service, lamps and jobs; queries no device and no database, waits for no
        disk."""
        return self.watching.health(stopping=self._stopping)

    def rig(self) -> RigView:
        """The poses of lights, cameras and projectors, and defaults of plans."""
        return RigView.of(self.rig_file)

    def ready(self) -> None:
        """Raise `NotReady` if no capture could start; a running one does not count."""
        problems = self.watching.problems()
        if not self._has_stage:
            problems.insert(0, "the service has not started")
        if problems:
            raise NotReady(problems)

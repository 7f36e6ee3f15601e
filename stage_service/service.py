"""The one seam between the routes and the rest of the service. Knows no HTTP."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

from reconstruction import Capture, CaptureError
from reconstruction.calibration.boards import CalibrationError
from reconstruction.containment import inside, is_file_name
from stage_service.acquisition.states import CaptureStatus, Outcome
from stage_service.calibrating import BoardView, Calibrating, CalibrationView
from stage_service.captures.catalogue import UnknownCapture
from stage_service.captures.control import Caller, Control
from stage_service.captures.manager import CaptureManager
from stage_service.captures.may_light import Moment, Word
from stage_service.captures.snapshots import SNAPSHOT, one_step
from stage_service.config import RigFile
from stage_service.decoding import Decoder
from stage_service.frames import FrameFigures, UnknownFrame, read_frame, steps_of
from stage_service.inputs import BadInput, check_kept, check_new, read_head, read_masks
from stage_service.jobs.follower import JobFollower
from stage_service.jobs.queue import JobQueue, NoSuchJob
from stage_service.leasing import Leasing
from stage_service.links import check_link
from stage_service.plan.capture_plan import CapturePlan
from stage_service.plan.cost import PlanCost
from stage_service.plan.resolved import resolve
from stage_service.queueing import Queueing, then
from stage_service.records.audit import Action
from stage_service.records.events import EventLog
from stage_service.records.refusals import Refusals
from stage_service.service_models import (
    AcknowledgeRequest,
    BoardQuery,
    CalibrationRequest,
    CaptureRequest,
    CaptureView,
    Health,
    LatchView,
    QueueRequest,
    RigView,
    SnapshotRequest,
    StepView,
)
from stage_service.stopping import NotEnded, Step, end_all
from stage_service.storage import NotThere, Storage
from stage_service.submitting import NotFinished, Submitting
from stage_service.trash import Removed
from stage_service.verification import Verification, Verifier
from stage_service.viewer import RemoteViewing, Source, Tracer
from stage_service.watching import NotReady, Watching

T = TypeVar("T")
FLUSH_S = 0.5
"""The end of the service waits for so long for the audit log's disk."""
LIGHTS_S = 6.0
"""And for so long for a capture's end: until lamps and projectors are read back dark, its folder is
finished and the stage given up (`STOP_WITHIN_S`, `TIDY_S`, `RELEASE_S`)."""
OTHERS_S = 3.0
"""And for all that lights nothing, beside that."""
READ_S = 1.0
"""A start waits for so long for the captures on the disk; the others are read beside it."""


class Service:
    """The captures, jobs and devices of one root folder, for routes and whoever else shows them.

    `start()` puts the lights off, looks what is on the disk and then follows the jobs, whose
    database nothing else waits for; `close()` puts the lights off again and may be called more than
    once, from any thread. What steers the stage is done in a caller's
    name, recorded, and refused (`Leased`) while somebody else holds the lease.
    """

    def __init__(
        self,
        rig_file: RigFile,
        root: Path,
        *,
        take_over: bool = False,
        gpu_workers: bool = False,
        verify_days: float | None = None,
    ) -> None:
        self.rig_file, self.root = rig_file, root
        self._captures = CaptureManager(
            rig_file, root, on_complete=self._completed, take_over=take_over
        )
        self._has_stage = False
        self._control = Control(self._captures.audit, self._captures.leases)
        self.queue = Queueing(root / "queue.json", self._captures, self._control, self._prepared)
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
        self._verifier = Verifier(
            root / "verified.json",
            self._captures.events,
            lambda: self._captures.running is not None,
            lambda: [c for c in self._captures.list() if c.outcome == "completed"],
            verify_days,
        )
        self.calibrating = Calibrating(root / "calibration", rig_file, self.events, self.decoder)
        self._closing = threading.Lock()
        self._stopping = self._closed = False
        self.not_ended: list[str] = []  # while it closes, and afterwards

    @property
    def events(self) -> EventLog:
        """Everything that happened to captures and jobs since the service started."""
        return self._captures.events

    def start(self) -> None:
        """Lights off; then, beside all else, what is on the disk, and the jobs: what a crash kept
        from being enqueued, and what becomes of them. What waits for the stage begins when all
        captures have been read.

        Raises `StageInUse`, and touches nothing, where another service has the stage.
        """
        if not self._has_stage:
            self.take_stage()
        self._captures.stage.darken()
        self._follower.start()
        self._captures.catalogue.begin(
            self._read, self._all_read, lambda: self._captures.running is not None, READ_S
        )
        self._verifier.start()

    def _read(self, status: CaptureStatus) -> None:
        if status.outcome == "completed":
            self._follower.follow_up(status, fresh=False)

    def _all_read(self) -> None:
        known = self._captures.list()
        self.queue.start(known)
        self.events.publish("captures.read", {"count": len(known)})

    def moment(self) -> Moment:
        """When a request comes: no blackout after it is undone by what it asks for."""
        return self._captures.moment()

    @property
    def unread(self) -> int:
        """Captures on the disk that are not listed yet."""
        return self._captures.catalogue.unread

    @property
    def running(self) -> str | None:
        """The id of the capture that is being shot; waits for nothing."""
        return self._captures.running

    def take_stage(self) -> None:
        """Have the stage for this service alone. Raises `StageInUse`."""
        self._captures.stage.take()
        self._has_stage = True

    def close(self) -> None:
        """Lights off and what runs aborted, and beside it everything else ended, each in its time
        (`LIGHTS_S`, `OTHERS_S`, `FLUSH_S`): what has not ended by then is in `not_ended`."""
        self._stopping = True
        with self._closing:
            if self._closed:
                return
            end_all(
                [
                    Step("lamps and capture", self._close_captures, LIGHTS_S),
                    Step("the queue", self.queue.close, OTHERS_S),
                    Step("reading captures again", self._verifier.close, OTHERS_S),
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
        """Cost a plan without touching a device. Raises `PlanError`."""
        return resolve(plan, self.rig_file).cost

    def start_capture(self, request: CaptureRequest, by: Caller) -> CaptureView:
        """Begin a capture. Raises `BadInput`, `Leased`, and what `CaptureManager.start` raises;
        `Forbidden` for a pipeline without the scope "jobs", or arming without "arm"."""
        word = self._control.word(by, "capture", request.armed_by)
        if request.pipeline is not None:
            by.require("jobs")
        work = partial(self._prepared(request), word)
        capture = self._control.do(by, "capture.start", work, None, detail=then(request))
        return self.capture(capture)

    def _prepared(self, request: CaptureRequest | QueueRequest) -> Callable[..., str]:
        """What starts the capture on a word, its head and masks read. Raises `BadInput`,
        `NotThere`, `NoStage`."""
        _ = self._captures.stage.devices  # of no use without: what waits would wait for ever
        given, folder = request.head, request.masks
        if request.upload is not None:
            if given is not None or folder is not None:
                raise BadInput("upload: give this, or head and masks; not both")
            given, folder = self.storage.uploaded(request.upload)
        if request.pipeline is not None:
            check_new(request.pipeline, self.rig_file.rig, given is not None)
        head = None
        if given is not None:
            head = read_head(given, self.decoder)
        masks = None
        if folder is not None:
            masks = read_masks(folder, self.rig_file.rig, self.decoder)
        asked = {"pipeline": request.pipeline.to_dict()} if request.pipeline is not None else {}

        def start(word: Word, **more: str) -> str:
            extra = {**asked, **more}
            return self._captures.start(
                request.plan, head=head, masks=masks, extra=extra, word=word
            )

        return start

    def capture(self, capture_id: str) -> CaptureView:
        """A capture's status. Raises `UnknownCapture`."""
        return self._view(self._captures.get(capture_id))

    def captures(
        self, limit: int, offset: int = 0, outcome: Outcome | None = None
    ) -> list[CaptureView]:
        """The latest `limit` captures, of that outcome, before the `offset` newest; oldest
        first."""
        known = self._captures.list()
        if outcome is not None:
            known = [status for status in known if status.outcome == outcome]
        end = max(0, len(known) - offset)
        return [self._view(status) for status in known[max(0, end - limit) : end]]

    def snapshot(self, request: SnapshotRequest, by: Caller) -> CaptureView:
        """Begin one exposure to look at: the capture "snapshot", which the next one replaces.
        Raises `PlanError`, `Busy`, `Unsafe`, `Leased`."""
        plan = one_step(self.rig_file, request.light, request.exposure, request.level)
        word, detail = self._control.word(by, "snapshot"), request.light or "all lights"
        work = partial(self._captures.snapshot, plan, word)
        return self._view(self._control.do(by, "snapshot", work, SNAPSHOT, detail=detail))

    def pause(self, capture_id: str, by: Caller) -> CaptureView:
        """Pause at the next step boundary. Raises `UnknownCapture`, `WrongState`, `Leased`."""
        work = partial(self._captures.pause, capture_id)
        return self._view(self._control.do(by, "capture.pause", work, capture_id))

    def resume(self, capture_id: str, by: Caller, armed_by: str | None = None) -> CaptureView:
        """Go on after a pause; of a capture that did not complete, shoot the frames it lacks.
        Raises `Forbidden` for arming without the scope "arm"."""
        word = self._control.word(by, "resume", armed_by)
        work = partial(self._captures.resume, capture_id, word)
        status = self._control.do(by, "capture.resume", work, capture_id)
        self._verifier.forget(capture_id)  # what was found wrong may be what is shot now
        return self._view(status)

    def abort(self, capture_id: str, by: Caller) -> CaptureView:
        """Abort at the next step boundary; anybody may. Raises `UnknownCapture`, `WrongState`."""

        def work() -> CaptureStatus:
            self._captures.get(capture_id)  # one that there is not holds nothing up
            self.queue.hold(f"abort of capture {capture_id} by {by}")
            return self._captures.abort(capture_id)

        return self._view(self._control.do(by, "capture.abort", work, capture_id, steers=False))

    def _view(self, status: CaptureStatus) -> CaptureView:
        """The status together with the job that follows it; asks no database."""
        return CaptureView(**status.model_dump(), job=self._follower.job_after(status.id))

    def _completed(self, status: CaptureStatus) -> None:
        self._follower.follow_up(status)

    def frame(self, capture_id: str, step: int, camera: str, read: Callable[[Path], T]) -> T:
        """What `read` makes of a frame's EXR file, wherever compression has just put it.

        Raises `UnknownCapture`, `UnknownFrame`, `MissingFrame`; `CaptureError` where the file is
        gone or cannot be read.
        """
        return read_frame(Capture(self.capture_path(capture_id)), step, camera, read)

    def preview(self, capture_id: str, step: int, camera: str, **look: Any) -> bytes:
        """A PNG of a frame, as `png_of_frame` makes it. Raises as `frame`, and `DecoderBusy`."""
        return self.frame(capture_id, step, camera, partial(self.decoder.preview, **look))

    def figures(self, capture_id: str, step: int, camera: str) -> FrameFigures:
        """How a frame is exposed. Raises as `frame`, and `DecoderBusy`."""

        def read(file: Path) -> FrameFigures:
            return FrameFigures.model_validate(self.decoder.figures(file))

        return self.frame(capture_id, step, camera, read)

    def steps(self, capture_id: str) -> list[StepView]:
        """What a capture shoots, in order, and which frames it has. Raises `UnknownCapture`,
        `CaptureError`."""
        return steps_of(Capture(self.capture_path(capture_id)))

    def board(self, capture_id: str, camera: str, board: BoardQuery) -> BoardView:
        """What a camera saw of a calibration's board. Raises as `frame`, and `BadInput`."""
        capture = Capture(self.capture_path(capture_id))
        if camera not in [c.name for c in capture.rig.cameras]:
            raise UnknownFrame(f"{capture_id} has no camera {camera!r}")
        try:
            return self.calibrating.look(capture.path, camera, board, board.calibrated)
        except CalibrationError as error:
            raise BadInput(str(error)) from error

    def calibrate(self, request: CalibrationRequest, by: Caller) -> CalibrationView:
        """Begin to calibrate the rig. Raises `UnknownCapture`, `NotFinished`, `BadInput`."""
        work = partial(self.calibrating.begin, request, self.done_capture)
        what = f"{len(request.boards)} boards, {len(request.diffuse + request.mirror)} spheres"
        try:
            return self._control.do(by, "calibrate", work, "rig", detail=what, steers=False)
        except CalibrationError as error:
            raise BadInput(str(error)) from error

    def calibrated(self) -> Path:
        """The calibrated rig file. Raises `NotThere`."""
        if not self.calibrating.rig.is_file():
            raise NotThere("no rig has been calibrated here yet")
        return self.calibrating.rig

    def done_capture(self, capture_id: str) -> Path:
        """The folder of a capture that nobody shoots. Raises `UnknownCapture`, `NotFinished`."""
        path = self.capture_path(capture_id)
        if self._captures.running == capture_id:
            raise NotFinished(f"capture {capture_id} is being shot")
        return path

    def remove_capture(self, capture_id: str, by: Caller, *, dry_run: bool) -> Removed:
        """Put a capture into the trash. Raises as `Storage.remove_capture`, and `BadInput` for a
        snapshot."""
        check_kept(capture_id)
        pending = self._follower.is_pending
        with self.jobs.lock:
            removed = self.storage.remove_capture(capture_id, pending, by, dry_run=dry_run)
        if not dry_run:
            self._verifier.forget(capture_id)
        return removed

    def verify(self, capture_id: str, by: Caller) -> Verification:
        """Have every file of a capture read again. Raises as `done_capture`, and `BadInput` for a
        snapshot."""
        check_kept(capture_id)
        work = partial(self._verifier.ask, capture_id, self.done_capture(capture_id))
        return self._control.do(by, "capture.verify", work, capture_id, steers=False)

    def verification(self, capture_id: str) -> Verification:
        """What was found when a capture was last read again. Raises `UnknownCapture`."""
        self.capture_path(capture_id)
        return self._verifier.get(capture_id)

    def capture_path(self, capture_id: str) -> Path:
        """The capture's folder; one that was put there by hand or by `import` counts too. Raises
        `UnknownCapture`, `LeadsOutside` for a link."""
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
        """Where a model for the viewer lies, with the capture of its name or of the job that made
        it. Raises `NotThere`."""
        model, captures = self.storage.whole_model(name).path, list[Path]()
        with suppress(UnknownCapture, CaptureError):
            captures.append(self.capture_path(name))
        if not captures:
            with suppress(NoSuchJob, CaptureError):
                captures.append(Path(self._queue.get(name).capture))
        return Source(model, tuple(captures))

    def devices(self) -> dict[str, Any]:
        """Each device and whether it answers; "safety": whether the lamps are known to be off."""
        return self._captures.devices()

    def blackout(self, by: Caller) -> dict[str, Any]:
        """All lamps and projectors off, verified; aborts a running capture. Anybody may."""
        self.queue.hold(f"blackout by {by}")
        return self._control.blackout(by, self._captures.blackout)

    def acknowledge(self, request: AcknowledgeRequest, by: Caller) -> dict[str, Any]:
        """Take a person's word that the lamps are off. They may still be at the stage: what waits
        begins when somebody says so, as after a blackout. Raises `CannotAcknowledge`, `Leased`."""
        stage, said = self._captures.stage, f"{request.name}: {request.note}"

        def work() -> None:
            stage.latch.check_acknowledge()
            self.queue.hold(f"lamps acknowledged as off by {by}")
            stage.acknowledge(said)

        self._control.do(by, "acknowledge", work, detail=said)
        return self._captures.safety()

    def record_login(self, by: Caller, action: str) -> Future[None]:
        """Note in the audit log who logged in or out; done once that is on the disk."""
        return self._control.audit.later(str(by), action, "service")

    def audit(self, limit: int) -> list[Action]:
        """The newest actions on the stage, refused ones too; the oldest of them first."""
        return self._control.audit.latest(limit)

    def health(self) -> Health:
        """How service, lamps and jobs are; asks no device, no database, waits for no disk."""
        free_bytes, worker = self.watching.disk()
        lamps, latched = self._captures.safety(), self._captures.stage.latch.latched
        problems = [p for p in (self._queue.set_aside, self._queue.problem) if p is not None]
        if self._stopping:
            problems.insert(0, "the service is stopping: it lights nothing any more")
        if damaged := self._verifier.damaged:
            problems.append(f"damaged when they were last read again: {', '.join(damaged[:5])}")
        if latched is not None:
            problems.insert(0, latched.detail)
        return Health(
            status="unsafe" if latched else "degraded" if problems else "ok",
            version=version("hairstage"),
            rig=self.rig_file.rig.name,
            root=str(self.root),
            worker=worker,
            capture=self._captures.running,
            unread=self.unread,
            lamps=lamps["state"],
            lamps_detail=lamps["detail"],
            lamps_accepted=lamps["accepted"],
            latch=LatchView.of(latched),
            disk_free_bytes=free_bytes,
            problems=problems,
        )

    def rig(self) -> RigView:
        """Where lights, cameras and projectors stand."""
        return RigView.of(self.rig_file)

    def ready(self) -> None:
        """Raise `NotReady` where no capture could begin, but for one that runs."""
        problems = self.watching.problems()
        if not self._has_stage:
            problems.insert(0, "the service has not started")
        if problems:
            raise NotReady(problems)

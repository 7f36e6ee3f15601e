"""What the routes call: captures, jobs and devices of one root folder. Knows no HTTP."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

import cv2
from pydantic import BaseModel, ConfigDict, Field

from reconstruction.capture.folder import Capture
from reconstruction.geometry.mesh import read_obj
from reconstruction.geometry.rig import Rig
from reconstruction.model import Model
from stage_service.acquisition.capture_status import CaptureStatus
from stage_service.acquisition.captures import CaptureManager, UnknownCapture
from stage_service.acquisition.control import Caller, Control
from stage_service.config import RigFile
from stage_service.jobs.pipelines import PIPELINES
from stage_service.jobs.queue import JobQueue, NoSuchJob, new_job_id
from stage_service.jobs.records import Job, PipelineRequest
from stage_service.jobs.slots import worker_is_alive
from stage_service.plan.capture_plan import CapturePlan
from stage_service.plan.cost import PlanCost
from stage_service.plan.resolved import resolve
from stage_service.records.events import EventLog

T = TypeVar("T")
NAME = r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,99}$"


class BadInput(ValueError):
    """A file that a request names cannot be used; the message names it and says why."""


class UnknownArtifact(LookupError):
    """The model folder has no such file."""


class UnknownFrame(LookupError):
    """The capture's plan has no such step or its rig no such camera."""


class NotFinished(RuntimeError):
    """What was asked for needs a capture or job that is done."""


class CaptureRequest(BaseModel):
    """A capture to make, and the job that follows it by itself when it completes.

    `head` is an OBJ file and `masks` a folder of `<camera>.png`, both on the service's machine.
    `armed_by` says who at the stage answers for flashes that the plan has consent for.
    """

    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        json_schema_extra={
            "examples": [
                {"plan": {}},
                {
                    "plan": {"projectors": [], "exposure": {"olat": 0.01}},
                    "head": "/data/subject/head.obj",
                    "pipeline": {
                        "name": "light_planes",
                        "options": {"held_out_cameras": ["cam_03"], "environment": "studio"},
                    },
                },
            ]
        },
    )

    plan: CapturePlan = CapturePlan()
    head: Path | None = None
    masks: Path | None = None
    pipeline: PipelineRequest | None = None
    armed_by: str | None = Field(default=None, min_length=1, max_length=100)


class JobRequest(BaseModel):
    """A pipeline to run on a capture; `model` names the model folder (default: a new one)."""

    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        json_schema_extra={
            "examples": [{"capture": "20261121-093000", "pipeline": {"name": "light_planes"}}]
        },
    )

    capture: str
    pipeline: PipelineRequest
    model: str | None = Field(default=None, pattern=NAME)


class CaptureView(CaptureStatus):
    """A capture's status and the job that its completion enqueued."""

    model_config = ConfigDict(
        frozen=True,
        json_schema_extra={
            "examples": [
                {
                    "id": "20261121-093000-1f2e",
                    "state": "done",
                    "outcome": "completed",
                    "error": None,
                    "path": "/data/stage/captures/20261121-093000-1f2e",
                    "steps": 545,
                    "step": 545,
                    "frames_planned": 4360,
                    "frames_written": 4360,
                    "frames_missing": 0,
                    "seconds_predicted": 29.6,
                    "seconds": 31.2,
                    "left_out": [],
                    "started": "2026-11-21T09:30:00.123+00:00",
                    "request": {"pipeline": {"name": "light_planes", "options": {}}},
                    "job": "job-20261121-093000-1f2e",
                }
            ]
        },
    )

    job: str | None


class Artifact(BaseModel):
    """A file of a model folder; `path` is relative to it."""

    path: str
    bytes: int


class Health(BaseModel):
    """Whether the service and its worker run; says nothing of the devices."""

    status: str
    version: str
    rig: str
    root: str
    worker: bool
    capture: str | None


class Stage:
    """The captures, jobs and devices of one root folder.

    `start()` puts the lights off and watches jobs for the event log; `close()` puts them off again
    and may be called more than once, from any thread. `control` steers in a caller's name.
    """

    def __init__(self, rig_file: RigFile, root: Path) -> None:
        self.rig_file, self.root = rig_file, root
        self.captures = CaptureManager(rig_file, root, on_complete=self._enqueue_pipeline)
        self.control = Control(self.captures)
        self.queue = JobQueue(root)
        self._closing = threading.Lock()
        self._closed = threading.Event()
        self._watcher = threading.Thread(target=self._watch_jobs, name="job-events", daemon=True)

    @property
    def events(self) -> EventLog:
        """Everything that happened to captures and jobs since the service started."""
        return self.captures.events

    def start(self) -> None:
        """Lights off; enqueue what a crash kept from being enqueued, and follow the jobs."""
        self.captures.darken()
        for status in self.captures.list():
            if status.outcome == "completed":
                self._enqueue_pipeline(status)
        self._watcher.start()

    def close(self) -> None:
        """Abort what runs, lights off; afterwards let go of the job database."""
        with self._closing:
            if self._closed.is_set():
                return
            try:
                self.captures.close()
            finally:
                self._closed.set()
        if self._watcher.is_alive():
            self._watcher.join(timeout=5)
        self.queue.close()

    def validate(self, plan: CapturePlan) -> PlanCost:
        """Cost a plan without touching a device. Raises `PlanError`."""
        return resolve(plan, self.rig_file).cost

    def start_capture(self, request: CaptureRequest, by: Caller) -> CaptureView:
        """Begin a capture. Raises `BadInput`, and what `Control.start` raises."""
        if request.pipeline is not None:
            _check_names(request.pipeline, self.rig_file.rig)
            if "reconstruct" not in PIPELINES[request.pipeline.name]:
                raise BadInput(
                    f"pipeline: {request.pipeline.name!r} works on strands that are there already; "
                    "a new capture has none"
                )
            if request.head is None:
                raise BadInput(
                    f"pipeline: {request.pipeline.name!r} roots strands on a scalp: give the head"
                )
        head = None
        if request.head is not None:
            try:
                head = read_obj(request.head)
            except (OSError, ValueError) as error:
                raise BadInput(f"head: {error}") from error
        capture = self.control.start(
            by,
            request.plan,
            armed_by=request.armed_by,
            head=head,
            masks=self._masks(request.masks) if request.masks is not None else None,
            extra={"pipeline": request.pipeline.model_dump(mode="json")}
            if request.pipeline is not None
            else {},
        )
        return self.capture(capture)

    def capture(self, capture_id: str) -> CaptureView:
        """A capture's status. Raises `UnknownCapture`."""
        return self.view(self.captures.get(capture_id))

    def view(self, status: CaptureStatus) -> CaptureView:
        """The status together with the job that follows it."""
        job = None
        if status.outcome == "completed" and status.request.get("pipeline") is not None:
            job = job_of(status.id)
            try:
                self.queue.get(job)
            except NoSuchJob:  # the capture's own thread is just about to enqueue it
                self._enqueue_pipeline(status)
        return CaptureView(**status.model_dump(), job=job)

    def frame(self, capture_id: str, step: int, camera: str, read: Callable[[Path], T]) -> T:
        """What `read` makes of a frame's EXR file, wherever compression has just put it.

        Raises `UnknownCapture`, `UnknownFrame`, `MissingFrame`.
        """
        capture = Capture(self.capture_path(capture_id))
        by_index = {s.index: s for s in capture.steps}
        cameras = [c.name for c in capture.rig.cameras]
        if step not in by_index or camera not in cameras:
            raise UnknownFrame(
                f"{capture_id} has the steps {min(by_index)} to {max(by_index)} and the cameras "
                f"{cameras}; got step {step}, camera {camera!r}"
            )
        return capture.read_file(by_index[step], camera, read)

    def capture_path(self, capture_id: str) -> Path:
        """The capture's folder; one that was put there by hand or by `import` counts too."""
        try:
            return self.captures.path(capture_id)
        except UnknownCapture:
            with contextlib.suppress(UnknownArtifact):
                path = inside(self.root / "captures", capture_id)
                if (path / "plan.json").is_file():
                    return path
            raise

    def submit(self, request: JobRequest) -> Job:
        """Enqueue a pipeline on a capture. Raises `UnknownCapture`, `NotFinished`, `BadInput`."""
        path = self.capture_path(request.capture)
        if not (path / "manifest.json").is_file():
            raise NotFinished(f"capture {request.capture} has no manifest yet: it is not finished")
        _check_names(request.pipeline, Capture(path).rig)
        job = new_job_id()
        model = self.root / "models" / (request.model or job)
        rebuilds = "reconstruct" in PIPELINES[request.pipeline.name]
        if not rebuilds and not (model / "strands.npz").is_file():
            raise BadInput(
                f"model: {request.pipeline.name!r} needs a model with strands: name one that "
                "'reconstruct' made"
            )
        return self.queue.submit(
            request.pipeline.name,
            path,
            model,
            request.pipeline.options,
            job=job,
        )

    def report(self, job_id: str) -> Path:
        """The job's `report.json`. Raises `NoSuchJob`, `UnknownArtifact`."""
        return self.artifact(job_id, "report.json")

    def artifacts(self, job_id: str) -> list[Artifact]:
        """The files in the job's model folder. Raises `NoSuchJob`."""
        model = Model(self.queue.get(job_id).model)
        return [
            Artifact(path=str(p), bytes=(model.path / p).stat().st_size) for p in model.listing()
        ]

    def artifact(self, job_id: str, path: str) -> Path:
        """A file of the job's model folder. Raises `NoSuchJob`, `UnknownArtifact`."""
        file = inside(Path(self.queue.get(job_id).model), path)
        if not file.is_file():
            raise UnknownArtifact(f"job {job_id} has no file {path!r}")
        return file

    def health(self) -> Health:
        """Whether service and worker run."""
        running = [c.id for c in self.captures.list() if c.state != "done"]
        return Health(
            status="ok",
            version=version("hairstage"),
            rig=self.rig_file.rig.name,
            root=str(self.root),
            worker=worker_is_alive(self.root),
            capture=running[0] if running else None,
        )

    def _masks(self, folder: Path) -> dict[str, Any]:
        masks = {}
        for camera in self.rig_file.rig.cameras:
            path = folder / f"{camera.name}.png"
            if not path.is_file():
                continue
            image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            if image is None or image.shape != (camera.height, camera.width):
                found = "not an image" if image is None else f"{image.shape[1]}x{image.shape[0]}"
                raise BadInput(
                    f"masks: {path}: expected {camera.width}x{camera.height}, got {found}"
                )
            masks[camera.name] = image >= 128
        if not masks:
            raise BadInput(f"masks: {folder} has no <camera>.png of this rig's cameras")
        return masks

    def _enqueue_pipeline(self, status: CaptureStatus) -> None:
        asked = status.request.get("pipeline")
        if asked is None:
            return
        pipeline = PipelineRequest(**asked)
        # One id per capture: enqueuing again after a crash is not a second job.
        self.queue.submit(
            pipeline.name,
            Path(status.path),
            self.root / "models" / status.id,
            pipeline.options,
            job=job_of(status.id),
        )

    def _watch_jobs(self) -> None:
        seen: dict[str, Job] = {}
        while not self._closed.wait(0.5):
            for job in self.queue.all(limit=50):
                before = seen.get(job.id)
                seen[job.id] = job
                if before is None or (before.state, before.outcome) != (job.state, job.outcome):
                    data = {"job": job.id, "state": job.state, "outcome": job.outcome}
                    self.events.publish("job.state", data)
                if job.progress is not None and (before is None or before.progress != job.progress):
                    data = {"job": job.id, **job.progress.model_dump(mode="json")}
                    self.events.publish("job.progress", data)


def job_of(capture_id: str) -> str:
    """The id of the job that a capture's completion enqueues."""
    return f"job-{capture_id}"


def inside(folder: Path, path: str) -> Path:
    """`folder / path`, or `UnknownArtifact` where that leads out of the folder."""
    root = folder.resolve()
    file = (root / path).resolve()
    if not file.is_relative_to(root) or file == root:
        raise UnknownArtifact(f"{path!r} is not a file in this folder")
    return file


def _check_names(pipeline: PipelineRequest, rig: Rig) -> None:
    for kind, wanted, known in (
        ("held_out_cameras", pipeline.options.held_out_cameras, rig.cameras),
        ("held_out_lights", pipeline.options.held_out_lights, rig.lights),
    ):
        unknown = set(wanted) - {x.name for x in known}
        if unknown:
            raise BadInput(f"pipeline.options.{kind}: the rig has no {sorted(unknown)}")

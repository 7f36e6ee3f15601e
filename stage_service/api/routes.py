"""Routes of captures, jobs and the service."""

from __future__ import annotations

from typing import Annotated
from urllib.parse import quote

from fastapi import APIRouter, Header, Query, Request, Response, status
from fastapi.responses import FileResponse, PlainTextResponse
from starlette.concurrency import run_in_threadpool

from stage_service.acquisition.states import Outcome
from stage_service.api.downloads import RANGES, file_response, opened_response
from stage_service.api.lanes import OnLanes
from stage_service.api.steering import READS, Anybody, OnService, Processes, Steers
from stage_service.frames import FrameFigures
from stage_service.jobs.records import Job
from stage_service.model_page.page import PAGE
from stage_service.plan.capture_plan import CapturePlan
from stage_service.plan.cost import PlanCost
from stage_service.service_models import (
    Artifact,
    CaptureRequest,
    CaptureView,
    Health,
    JobRequest,
    ResumeRequest,
    RigView,
    SnapshotRequest,
    StepView,
)
from stage_service.watching import text_of
from stage_service.web.headers import presented, report_policy

router = APIRouter()
reading = APIRouter(dependencies=READS)


@reading.post("/plans:validate", tags=["captures"])
def validate_plan(plan: CapturePlan, service: OnService) -> PlanCost:
    """Cost of a plan on this rig: frames, bytes, seconds, light dose. Lights no lamp."""
    return service.validate(plan)


@router.post("/captures", status_code=status.HTTP_202_ACCEPTED, tags=["captures"])
def start_capture(
    body: CaptureRequest, service: OnService, by: Steers, response: Response
) -> CaptureView:
    """Start a capture. With `pipeline`, its completion enqueues that job."""
    view = service.start_capture(body, by)
    response.headers["Location"] = f"/captures/{view.id}"
    return view


@router.post("/snapshot", status_code=status.HTTP_202_ACCEPTED, tags=["captures"])
def take_snapshot(body: SnapshotRequest, service: OnService, by: Steers) -> CaptureView:
    """Take one exposure for viewing. It is the capture "snapshot" until the next one; it is not
    listed, and its frames are served as those of any capture."""
    return service.snapshot(body, by)


@reading.get("/captures", tags=["captures"])
def list_captures(
    service: OnService,
    response: Response,
    limit: Annotated[int, Query(ge=1, le=1000)] = 200,
    offset: Annotated[int, Query(ge=0, le=10**9, description="newer ones skipped")] = 0,
    outcome: Annotated[Outcome | None, Query(description="only these")] = None,
) -> list[CaptureView]:
    """The latest captures, the oldest of them first. After a start the service reads the folders,
    the newest first: the header `Hairstage-Unread` has the number of unread ones; the event
    "captures.read" follows the last."""
    response.headers["Hairstage-Unread"] = str(service.unread)
    return service.captures(limit, offset, outcome)


@reading.get("/captures/{capture}", tags=["captures"])
def get_capture(capture: str, service: OnService) -> CaptureView:
    """State and outcome of a capture, and its job."""
    return service.capture(capture)


@reading.get("/captures/{capture}/steps", tags=["captures"])
def get_steps(capture: str, service: OnService) -> list[StepView]:
    """Steps of a capture in order, with their lights."""
    return service.frames.steps(capture)


@router.post("/captures/{capture}/pause", tags=["captures"])
def pause_capture(capture: str, service: OnService, by: Steers) -> CaptureView:
    """Pause at the next step boundary, lights off."""
    return service.pause(capture, by)


@router.post("/captures/{capture}/resume", tags=["captures"])
def resume_capture(
    capture: str, service: OnService, by: Steers, body: ResumeRequest | None = None
) -> CaptureView:
    """Resume after a pause; shoot the missing frames of an incomplete capture."""
    return service.resume(capture, by, None if body is None else body.armed_by)


@router.post("/captures/{capture}/abort", tags=["captures"])
async def abort_capture(
    capture: str, service: OnService, lanes: OnLanes, by: Anybody
) -> CaptureView:
    """Abort at the next step boundary, lights off; finished frames stay."""
    return await lanes.dark(service.abort, capture, by)


@reading.get(
    "/captures/{capture}/frames/{step}/{camera}.exr",
    response_class=Response,
    responses={**RANGES, 200: {"content": {"image/x-exr": {}}}},
    tags=["captures"],
)
def get_frame(capture: str, step: int, camera: str, service: OnService) -> Response:
    """A frame as it was written: scene-linear radiance, W/(sr m²)."""
    file = service.frames.read(capture, step, camera, lambda path: path.open("rb"))
    return opened_response(file, "image/x-exr", f"{capture}-{step}-{camera}.exr")


@reading.get(
    "/captures/{capture}/frames/{step}/{camera}.png",
    response_class=Response,
    responses={200: {"content": {"image/png": {}}}},
    tags=["captures"],
)
def get_preview(
    capture: str,
    step: int,
    camera: str,
    service: OnService,
    percentile: Annotated[
        float, Query(ge=50, le=100, description="percentile that becomes white")
    ] = 99.5,
    white: Annotated[
        float | None,
        Query(ge=1e-30, le=1e30, description="radiance that becomes white instead, W/(sr m²)"),
    ] = None,
    size: Annotated[
        int | None, Query(ge=8, le=4096, description="pixels of the longer side")
    ] = None,
    mark: Annotated[bool, Query(description="mark saturated pixels")] = False,
) -> Response:
    """An sRGB preview of a frame, exposed by a percentile, or by `white` so that frames can be
    compared, reduced to `size`."""
    look = {"percentile": percentile, "white": white, "size": size, "mark": mark}
    picture = service.frames.preview(capture, step, camera, **look)
    return Response(picture, media_type="image/png")


@reading.get("/captures/{capture}/frames/{step}/{camera}.json", tags=["captures"])
def get_figures(capture: str, step: int, camera: str, service: OnService) -> FrameFigures:
    """Exposure and sharpness of a frame."""
    return service.frames.figures(capture, step, camera)


@router.post("/jobs", status_code=status.HTTP_202_ACCEPTED, tags=["jobs"])
async def submit_job(
    body: JobRequest,
    service: OnService,
    lanes: OnLanes,
    by: Processes,
    response: Response,
    idempotency_key: Annotated[str | None, Header(min_length=1, max_length=200)] = None,
) -> Job:
    """Enqueue a pipeline on a finished capture. Repeated by the same caller with the same
    `Idempotency-Key` it returns the same job; a key of another request is 409."""
    job = await lanes.jobs(service.jobs.submit, body, by, idempotency_key)
    response.headers["Location"] = f"/jobs/{job.id}"
    return job


@reading.get("/jobs", tags=["jobs"])
async def list_jobs(
    service: OnService,
    lanes: OnLanes,
    limit: Annotated[int, Query(ge=1, le=1000)] = 200,
    offset: Annotated[int, Query(ge=0, le=10**9, description="newer ones skipped")] = 0,
) -> list[Job]:
    """The latest jobs, newest first."""
    return await lanes.jobs(service.jobs.latest, limit, offset)


@reading.get("/jobs/{job}", tags=["jobs"])
async def get_job(job: str, service: OnService, lanes: OnLanes) -> Job:
    """A job's state, progress, and outcome."""
    return await lanes.jobs(service.jobs.get, job)


@router.delete("/jobs/{job}", tags=["jobs"])
async def cancel_job(job: str, service: OnService, lanes: OnLanes, by: Processes) -> Job:
    """Cancel a job: a queued one at once, a running one at its next progress call."""
    return await lanes.jobs(service.jobs.cancel, job, by)


@reading.get("/jobs/{job}/report", response_class=FileResponse, responses=RANGES, tags=["jobs"])
async def get_report(job: str, service: OnService, lanes: OnLanes) -> Response:
    """The job's report: seconds, error against time, skipped work, warnings by stage."""
    file = await lanes.jobs(service.jobs.artifact, job, "report.json")
    return file_response(file, "application/json")


@reading.get("/jobs/{job}/artifacts", tags=["jobs"])
async def list_artifacts(job: str, service: OnService, lanes: OnLanes) -> list[Artifact]:
    """The files in the job's model folder."""
    return await lanes.jobs(service.jobs.artifacts, job)


@reading.get(
    "/jobs/{job}/artifacts/{path:path}",
    response_class=FileResponse,
    responses=RANGES,
    tags=["jobs"],
)
async def get_artifact(
    job: str, path: str, request: Request, service: OnService, lanes: OnLanes
) -> Response:
    """A file of the model folder. Browsers show images, JSON and, without scripts, `index.html`,
    and save other files."""
    file = await lanes.jobs(service.jobs.artifact, job, path)
    if path == PAGE:
        response = file_response(file, "text/html; charset=utf-8")
        prefix = request.app.state.access.prefix
        folder = prefix + request.url.path.removesuffix(PAGE)
        response.headers.update(report_policy(request.headers["host"], quote(folder)))
        return response
    kind, headers = await run_in_threadpool(presented, file)
    response = file_response(file, kind)
    response.headers.update(headers)
    return response


@reading.get("/rig", tags=["service"])
async def get_rig(service: OnService) -> RigView:
    """Positions of lights, cameras and projectors, and the rig file's defaults."""
    return service.rig()


@reading.get("/health", tags=["service"])
async def health(service: OnService, lanes: OnLanes) -> Health:
    """Last known state of service, lamps and jobs; queries no device and no database."""
    return await lanes.health(service.health)


@reading.get("/ready", tags=["service"])
async def ready(service: OnService, lanes: OnLanes) -> dict[str, bool]:
    """Whether a capture could start if none is running; 503 with the reasons if not. Queries no
    device and no database."""
    await lanes.health(service.ready)
    return {"ready": True}


@reading.get("/metrics", response_class=PlainTextResponse, tags=["service"])
async def metrics(service: OnService, lanes: OnLanes) -> Response:
    """Metrics for Prometheus, with their age. Queries no device and no database."""
    text = await lanes.health(lambda: text_of(service.watching.metrics()))
    return Response(text, media_type="text/plain; version=0.0.4; charset=utf-8")

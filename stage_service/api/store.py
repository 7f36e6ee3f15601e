"""Routes of the root folder: downloads, uploads, trash."""

from __future__ import annotations

import threading
from pathlib import Path as FolderPath
from typing import Annotated

from fastapi import APIRouter, Path, Query, Request, Response
from starlette.concurrency import run_in_threadpool

from reconstruction.containment import LONGEST_NAME
from stage_service.api.downloads import RANGES, tar_response
from stage_service.api.lanes import OnLanes
from stage_service.api.steering import READS, Administrates, OnService, Steers
from stage_service.service_models import FILE_NAME
from stage_service.storage import KEPT_DAYS, Folder, files_of
from stage_service.trash import Removed

router = APIRouter(tags=["storage"])
reading = APIRouter(dependencies=READS, tags=["storage"])
DryRun = Annotated[bool, Query(description="only list what would be removed")]
Subject = Annotated[str, Path(pattern=FILE_NAME, max_length=LONGEST_NAME)]
TAR = {
    **RANGES,
    200: {"content": {"application/x-tar": {}}},
    206: {"content": {"application/x-tar": {}}, **RANGES[206]},
}
OBJ = {"requestBody": {"required": True, "content": {"model/obj": {}}}}
PNG = {"requestBody": {"required": True, "content": {"image/png": {}}}}


_LISTING = threading.Lock()
"""A capture's files take 0.3 s to list; a dozen lists at once would delay all other requests."""


@router.delete("/captures/{capture}")
async def remove_capture(
    capture: str, service: OnService, lanes: OnLanes, by: Steers, dry_run: DryRun = False
) -> Removed:
    """Move a capture to the trash; a completed one needs the scope admin."""
    return await lanes.jobs(service.remove_capture, capture, by, dry_run=dry_run)


@reading.get("/captures/{capture}/archive.tar", response_class=Response, responses=TAR)
def get_capture_archive(capture: str, service: OnService) -> Response:
    """All files of a finished capture as a tar file, with ranges to resume."""
    return _archive("capture", capture, service.done_capture(capture))


@reading.get("/models")
def list_models(service: OnService) -> list[Folder]:
    """The models, by name."""
    return service.storage.models()


@router.delete("/models/{model}")
async def remove_model(
    model: str, service: OnService, lanes: OnLanes, by: Administrates, dry_run: DryRun = False
) -> Removed:
    """Move a model to the trash; needs the scope admin."""
    return await lanes.jobs(service.storage.remove_model, model, by, dry_run=dry_run)


@reading.get("/models/{model}/archive.tar", response_class=Response, responses=TAR)
def get_model_archive(model: str, service: OnService) -> Response:
    """All complete files of a model as a tar file."""
    return _archive("model", model, service.storage.model(model).path)


@reading.get("/trash")
def list_trash(service: OnService) -> list[Removed]:
    """Entries of the trash, the oldest first."""
    return service.storage.trash()


@router.post("/trash/{name}/restore")
def restore(name: str, service: OnService, by: Administrates) -> Removed:
    """Restore an entry; needs the scope admin."""
    return service.storage.restore(name, by)


@router.delete("/trash")
def empty_trash(
    service: OnService,
    by: Administrates,
    older_than_days: Annotated[float, Query(ge=0, le=10_000)] = KEPT_DAYS,
    dry_run: DryRun = False,
) -> list[Removed]:
    """Delete entries older than so many days for good; needs the scope admin."""
    return service.storage.empty(older_than_days, by, dry_run=dry_run)


@reading.get("/uploads")
def list_uploads(service: OnService) -> list[Folder]:
    """Uploads by subject."""
    return service.storage.uploads()


@router.put("/uploads/{subject}/head.obj", openapi_extra=OBJ)
async def upload_head(subject: Subject, request: Request, service: OnService, by: Steers) -> Folder:
    """Store a subject's head, a Wavefront OBJ, for captures that name it as `upload`."""
    data = await request.body()
    return await run_in_threadpool(service.storage.upload_head, subject, data, by)


@router.put("/uploads/{subject}/masks/{camera}.png", openapi_extra=PNG)
async def upload_mask(
    subject: Subject, camera: str, request: Request, service: OnService, by: Steers
) -> Folder:
    """Store a subject's hair mask of a camera, in the size of its frames."""
    data, rig = await request.body(), service.rig_file.rig
    return await run_in_threadpool(service.storage.upload_mask, subject, camera, data, rig, by)


@router.delete("/uploads/{subject}")
def remove_upload(subject: Subject, service: OnService, by: Steers) -> Folder:
    """Delete a subject's uploads; captures keep their copies."""
    return service.storage.remove_upload(subject, by)


def _archive(kind: str, name: str, folder: FolderPath) -> Response:
    with _LISTING:
        return tar_response(name, files_of(f"the {kind} {name}", folder))

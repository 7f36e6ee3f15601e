"""Routes of the queue of captures."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query, Response, status

from stage_service.api.lanes import OnLanes
from stage_service.api.steering import READS, Anybody, OnService, Steers
from stage_service.captures.capture_queue import Entry
from stage_service.service_models import (
    GoOnRequest,
    MoveRequest,
    QueueRequest,
    QueueView,
    ResumeRequest,
)

router = APIRouter(tags=["queue"])
reading = APIRouter(dependencies=READS, tags=["queue"])


@reading.get("/queue")
def get_queue(service: OnService) -> QueueView:
    """Queued captures, the next one first, and the reason why it waits."""
    return service.queue.view()


@reading.get("/queue/history")
def get_history(
    service: OnService, limit: Annotated[int, Query(ge=1, le=1000)] = 100
) -> list[Entry]:
    """Captures that were started or removed, the newest first."""
    return service.queue.history(limit)


@router.post("/queue", status_code=status.HTTP_201_CREATED)
def enqueue(body: QueueRequest, service: OnService, by: Steers, response: Response) -> Entry:
    """Queue a capture; it starts when the stage is free, dark and not latched."""
    entry = service.queue.add(body, by)
    response.headers["Location"] = "/queue"
    return entry


@router.patch("/queue/{entry}")
def move(entry: str, body: MoveRequest, service: OnService, by: Steers) -> Entry:
    """Move a queued capture to another position, from 0."""
    return service.queue.move(entry, body.place, by)


@router.delete("/queue/{entry}")
def remove(entry: str, service: OnService, by: Steers) -> Entry:
    """Remove a queued capture."""
    return service.queue.remove(entry, by)


@router.post("/queue/{entry}/start", status_code=status.HTTP_202_ACCEPTED)
def start_one(
    entry: str, service: OnService, by: Steers, body: ResumeRequest | None = None
) -> Entry:
    """Start a queued capture now, out of order: the only way for a plan that flashes, armed."""
    return service.queue.start_one(entry, by, None if body is None else body.armed_by)


@router.post("/queue:hold")
async def hold(service: OnService, lanes: OnLanes, by: Anybody) -> QueueView:
    """Hold the queue. A start of the service, a blackout, an abort, a failed capture and a jump of
    the clock hold it too."""
    return await lanes.dark(service.queue.hold_by, by)


@router.post("/queue:go-on")
def go_on(body: GoOnRequest, service: OnService, by: Steers) -> QueueView:
    """Release the queue. The caller confirms the reason of the hold by its id; 409 with the present
    reason if it has changed."""
    return service.queue.go_on(body.hold, by)

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
    """What waits for the stage, the next one first, and what it waits for."""
    return service.queue.view()


@reading.get("/queue/history")
def get_history(
    service: OnService, limit: Annotated[int, Query(ge=1, le=1000)] = 100
) -> list[Entry]:
    """What was started from the queue, or removed; the newest first."""
    return service.queue.history(limit)


@router.post("/queue", status_code=status.HTTP_201_CREATED)
def enqueue(body: QueueRequest, service: OnService, by: Steers, response: Response) -> Entry:
    """Let a capture wait; it begins by itself when the stage is free, dark and not latched."""
    entry = service.queue.add(body, by)
    response.headers["Location"] = "/queue"
    return entry


@router.patch("/queue/{entry}")
def move(entry: str, body: MoveRequest, service: OnService, by: Steers) -> Entry:
    """Put what waits at another place, from 0."""
    return service.queue.move(entry, body.place, by)


@router.delete("/queue/{entry}")
def remove(entry: str, service: OnService, by: Steers) -> Entry:
    """Take out what waits."""
    return service.queue.remove(entry, by)


@router.post("/queue/{entry}/start", status_code=status.HTTP_202_ACCEPTED)
def start_one(
    entry: str, service: OnService, by: Steers, body: ResumeRequest | None = None
) -> Entry:
    """Start what waits now, out of turn; the only way for a plan that flashes, armed."""
    return service.queue.start_one(entry, by, None if body is None else body.armed_by)


@router.post("/queue:hold")
async def hold(service: OnService, lanes: OnLanes, by: Anybody) -> QueueView:
    """Begin nothing by itself any more. So do a start of the service, a blackout, an abort, a
    capture that fails, a jump of the clock."""
    return await lanes.dark(service.queue.hold_by, by)


@router.post("/queue:go-on")
def go_on(body: GoOnRequest, service: OnService, by: Steers) -> QueueView:
    """Begin what waits again, one after the other: the caller has read why it is held. Where
    something has happened since, it is 409, with the reason."""
    return service.queue.go_on(body.hold, by)

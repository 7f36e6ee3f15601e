"""Server-sent events: numbered, and replayable from `Last-Event-ID`."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from dataclasses import asdict
from typing import Annotated

from fastapi import APIRouter, Header, HTTPException, Query, Request
from sse_starlette import EventSourceResponse, ServerSentEvent

from stage_service.api.connections import MOST_STREAMS
from stage_service.api.steering import READS
from stage_service.records.events import EventLog
from stage_service.records.tokens import Identity

reading = APIRouter(dependencies=READS)
POLL_S = 0.5


@reading.get(
    "/events",
    response_class=EventSourceResponse,
    responses={200: {"content": {"text/event-stream": {}}}},
    tags=["service"],
)
async def stream_events(
    request: Request,
    last_event_id: Annotated[int | None, Header(ge=0)] = None,
    after: Annotated[int | None, Query(ge=0, description="as Last-Event-ID")] = None,
) -> EventSourceResponse:
    """Events after `Last-Event-ID` (or `after`), then new ones as they come.

    Without either, only new ones; 0 replays all that are kept. Numbers start at 1 with the service:
    a number that it has not reached yet is from before a restart, and replays everything. A token
    that is revoked ends it.
    """
    if request.app.state.streams >= MOST_STREAMS:
        raise HTTPException(503, f"{MOST_STREAMS} listeners follow the events already")
    events: EventLog = request.app.state.service.events
    asked = last_event_id if last_event_id is not None else after
    newest = events.last
    start = newest if asked is None else asked
    return EventSourceResponse(_follow(request, events, start if start <= newest else 0))


async def _follow(
    request: Request, events: EventLog, number: int
) -> AsyncIterator[ServerSentEvent]:
    request.app.state.streams += 1
    try:
        while not await request.is_disconnected() and _may(request):
            for event in await asyncio.to_thread(events.wait, number, POLL_S):
                number, data = event.number, json.dumps(asdict(event))
                yield ServerSentEvent(id=str(number), event=event.kind, data=data)
    finally:
        request.app.state.streams -= 1


def _may(request: Request) -> bool:
    """Whether the token still opens what it did: one that is revoked ends what follows events."""
    identity: Identity | None = request.state.identify(request.headers)
    return identity == request.state.identity

"""Server-sent events: numbered, and replayable from `Last-Event-ID`."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import suppress
from dataclasses import asdict
from typing import Annotated

from fastapi import APIRouter, Header, HTTPException, Query, Request
from sse_starlette import EventSourceResponse, ServerSentEvent

from stage_service.api.connections import MOST_STREAMS
from stage_service.api.steering import READS
from stage_service.records.events import EventLog
from stage_service.records.tokens import Identity

reading = APIRouter(dependencies=READS)
LOOK_S = 0.5
"""How often a stream looks whether its token still opens it."""
PACE_S = 1e-3
"""From one round of news to the next, for each listener: telling one takes a fraction of it, so
that requests have the rest."""
PULSE_S = 1.0
"""A stream that has no event for so long carries a comment: whoever reads it can tell a service
that has nothing to report from one that has stopped."""
_PULSE = b": pulse\r\n\r\n"
MOST_AT_ONCE, MOST_PLACES = 500, 20
"""Events in one piece, and pieces that are kept for others who stand at the same place."""


class Feed:
    """The events as bytes, for many listeners on one event loop; no thread waits for any.

    What has happened is told to all of them at once, in rounds; who stands at the same event as
    another is given the same bytes.
    """

    def __init__(self, events: EventLog) -> None:
        self._events = events
        self.listeners = 0
        self._loop: asyncio.AbstractEventLoop | None = None
        self._news = asyncio.Event()
        self._told, self._told_at, self._due = 0, 0.0, False
        self._made: dict[int, tuple[int, bytes]] = {}

    async def after(self, number: int, within_s: float) -> tuple[int, bytes]:
        """The number of the last event of those after `number` that come within this time, and
        their text; `number` and nothing where none comes."""
        if self._loop is None:
            self._loop = asyncio.get_running_loop()
            self._events.tell(self._happened)
            self._told = self._events.last
        if self._told <= number:
            with suppress(TimeoutError):
                async with asyncio.timeout(within_s):
                    await self._news.wait()
        if self._told <= number:
            return number, b""
        if number not in self._made:
            if len(self._made) >= MOST_PLACES:
                self._made.clear()
            self._made[number] = self._text(number)
        return self._made[number]

    def _text(self, number: int) -> tuple[int, bytes]:
        found = self._events.after(number, MOST_AT_ONCE)
        text = b"".join(
            ServerSentEvent(
                id=str(event.number), event=event.kind, data=json.dumps(asdict(event))
            ).encode()
            for event in found
        )
        return found[-1].number, text

    def _happened(self) -> None:
        """From any thread."""
        if not self._due and self._loop is not None:
            self._due = True
            with suppress(RuntimeError):  # the loop is closed: nobody listens any more
                self._loop.call_soon_threadsafe(self._tell_soon)

    def _tell_soon(self) -> None:
        loop = asyncio.get_running_loop()
        loop.call_at(max(loop.time(), self._told_at + PACE_S * self.listeners), self._tell)

    def _tell(self) -> None:
        self._due = False  # first: what happens from here on is for the next round
        self._told, self._told_at = self._events.last, asyncio.get_running_loop().time()
        self._made.clear()
        news, self._news = self._news, asyncio.Event()
        news.set()


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
    that is revoked, or a login that ends, ends it. Without events a comment comes every second.
    """
    feed: Feed = request.app.state.feed
    if feed.listeners >= MOST_STREAMS:
        raise HTTPException(503, f"{MOST_STREAMS} listeners follow the events already")
    asked = last_event_id if last_event_id is not None else after
    newest = request.app.state.service.events.last
    start = newest if asked is None else asked
    follow = _follow(request, feed, start if start <= newest else 0)
    return EventSourceResponse(follow, ping=86400)  # `_PULSE` replaces its comments


async def _follow(request: Request, feed: Feed, number: int) -> AsyncIterator[bytes]:
    clock = asyncio.get_running_loop().time
    feed.listeners += 1
    sent = clock()
    try:
        while _may(request):
            looked = clock()
            while (left := looked + LOOK_S - clock()) > 0:
                number, text = await feed.after(number, left)
                if text:
                    sent = clock()
                    yield text
            if clock() - sent >= PULSE_S:
                sent = clock()
                yield _PULSE
    finally:
        feed.listeners -= 1


def _may(request: Request) -> bool:
    """Whether the caller may still do what they might: a token that is revoked ends the stream."""
    identity: Identity | None = request.state.identify(request.headers)
    return identity == request.state.identity

"""Server-sent events: numbered, and replayable from `Last-Event-ID`."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict
from typing import Annotated

from fastapi import APIRouter, Header, Query, Request
from sse_starlette import EventSourceResponse, ServerSentEvent
from starlette.types import Receive, Scope, Send

from stage_service.api.entrance import no_place, owner_of
from stage_service.api.places import NoPlace, Places
from stage_service.api.steering import READS
from stage_service.api.throttle import Throttle, Turn
from stage_service.records.events import EventLog
from stage_service.records.tokens import Identity

reading = APIRouter(dependencies=READS)
LOOK_S = 0.5
"""Seconds between checks of a stream's token."""
PACE_S, OTHERS_PACE_S = 1e-3, 10e-3
"""Seconds per listener between two rounds of events, with the scope `steer` and without. Sending to
one listener takes about 0.1 ms, so listeners without `steer` take 1 % of a capture's time."""
PULSE_S = 1.0
"""A stream without events carries a comment after so many seconds, which distinguishes an idle
service from a stopped one."""
_PULSE = b": pulse\r\n\r\n"
MOST_AT_ONCE, MOST_PLACES = 500, 20
"""Events per chunk; cached chunks for listeners at the same event."""
FEW = 50
"""Events that a listener without `steer` gets without a turn."""


class Feed:
    """The events as bytes, for many listeners on one event loop.

    Events are sent in rounds to all listeners, in separate rounds to those with the scope `steer`.
    Listeners at the same event share the same bytes.
    """

    def __init__(self, events: EventLog) -> None:
        self._events = events
        self._loop: asyncio.AbstractEventLoop | None = None
        self._made: dict[int, tuple[int, bytes]] = {}
        self._rounds = {
            steers: _Rounds(events, self._made, PACE_S if steers else OTHERS_PACE_S)
            for steers in (True, False)
        }

    @contextmanager
    def listening(self, steers: bool) -> Iterator[None]:
        """Count a listener for as long as the block."""
        if self._loop is None:
            self._loop = asyncio.get_running_loop()
            self._events.subscribe(self._happened)
        rounds = self._rounds[steers]
        if not rounds.listeners:
            rounds.sent = self._events.last
        rounds.listeners += 1
        try:
            yield
        finally:
            rounds.listeners -= 1

    def pending(self, number: int, steers: bool) -> int:
        """How many events after that one may be sent now."""
        return self._rounds[steers].sent - number

    async def after(self, number: int, within_s: float, steers: bool) -> tuple[int, bytes]:
        """Events after `number` that come within this time: the last one's number, and their text;
        `number` and nothing if none comes."""
        rounds = self._rounds[steers]
        if rounds.sent <= number:
            with suppress(TimeoutError):
                async with asyncio.timeout(within_s):
                    await rounds.news.wait()
        if rounds.sent <= number:
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
        if self._loop is not None and any(r.idle for r in self._rounds.values()):
            with suppress(RuntimeError):  # the loop is closed
                self._loop.call_soon_threadsafe(self._schedule)

    def _schedule(self) -> None:
        for rounds in self._rounds.values():
            rounds.schedule()


class _Rounds:
    """Rounds of one group of listeners: when events are sent, and up to which."""

    def __init__(self, events: EventLog, made: dict[int, tuple[int, bytes]], pace_s: float) -> None:
        self._events, self._made, self._pace_s = events, made, pace_s
        self.listeners = 0
        self.sent, self._sent_at, self._due = 0, 0.0, False
        self.news = asyncio.Event()

    @property
    def idle(self) -> bool:
        """Whether there are listeners and no round is scheduled."""
        return self.listeners > 0 and not self._due

    def schedule(self) -> None:
        """Schedule a round, at the pace of the group."""
        if self.idle:
            self._due = True
            loop = asyncio.get_running_loop()
            soonest = self._sent_at + self._pace_s * self.listeners
            loop.call_at(max(loop.time(), soonest), self._send)

    def _send(self) -> None:
        self._due = False  # first: later events are for the next round
        self.sent, self._sent_at = self._events.last, asyncio.get_running_loop().time()
        self._made.clear()
        news, self.news = self.news, asyncio.Event()
        news.set()


class _Stream(EventSourceResponse):
    """Events for a listener that has a place."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send events until the client leaves, or 429 or 503."""
        places: Places = scope["app"].state.places
        try:
            with places.holding("streams", owner_of(scope)):
                await super().__call__(scope, receive, send)
        except NoPlace as error:
            await no_place(scope, error)(scope, receive, send)


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

    Without either, only new ones; 0 replays all stored events. Numbers start at 1 with the service:
    a number that it has not reached is from before a restart and replays everything. The stream
    ends when its token is revoked or its login ends. Without events a comment is sent every second.
    """
    requested = last_event_id if last_event_id is not None else after
    newest = request.app.state.service.events.last
    start = newest if requested is None else requested
    follow = _follow(request, start if start <= newest else 0)
    return _Stream(follow, ping=86400)  # `_PULSE` replaces its comments


async def _follow(request: Request, number: int) -> AsyncIterator[bytes]:
    feed: Feed = request.app.state.feed
    throttle: Throttle = request.app.state.throttle
    owner, clock = owner_of(request.scope), asyncio.get_running_loop().time
    sent = clock()
    with feed.listening(owner.steers):
        while _may(request):
            checked = clock()
            while (left := checked + LOOK_S - clock()) > 0:
                much = not owner.steers and feed.pending(number, owner.steers) > FEW
                turn = await throttle.turn(owner, patient=True) if much else Turn()
                try:
                    number, text = await feed.after(number, left, owner.steers)
                finally:
                    turn.end()
                if text:
                    sent = clock()
                    yield text
            if clock() - sent >= PULSE_S:
                sent = clock()
                yield _PULSE


def _may(request: Request) -> bool:
    """Whether the caller's identity is unchanged: a revoked token ends the stream."""
    identity: Identity | None = request.state.identify(request.headers)
    return identity == request.state.identity

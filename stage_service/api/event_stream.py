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
from stage_service.api.pace import Pace, Turn
from stage_service.api.places import NoPlace, Places
from stage_service.api.steering import READS
from stage_service.records.events import EventLog
from stage_service.records.tokens import Identity

reading = APIRouter(dependencies=READS)
LOOK_S = 0.5
"""How often a stream looks whether its token still opens it."""
PACE_S, OTHERS_PACE_S = 1e-3, 10e-3
"""From one round of news to the next, for each listener that may steer, and for each other: telling
one takes about 0.1 ms, so that requests have the rest, and others take 1 % of a capture's time."""
PULSE_S = 1.0
"""A stream that has no event for so long carries a comment: whoever reads it can tell a service
that has nothing to report from one that has stopped."""
_PULSE = b": pulse\r\n\r\n"
MOST_AT_ONCE, MOST_PLACES = 500, 20
"""Events in one piece, and pieces that are kept for others who stand at the same place."""
FEW = 50
"""Events that a listener without `steer` is given without a turn of its own."""


class Feed:
    """The events as bytes, for many listeners on one event loop; no thread waits for any.

    What has happened is sent to all of them at once, in rounds: those who may steer have rounds of
    their own. Who stands at the same event as another is given the same bytes.
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
        """The number of the last event of those after `number` that come within this time, and
        their text; `number` and nothing where none comes."""
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
            with suppress(RuntimeError):  # the loop is closed: nobody listens any more
                self._loop.call_soon_threadsafe(self._tell_soon)

    def _tell_soon(self) -> None:
        for rounds in self._rounds.values():
            rounds.tell_soon()


class _Rounds:
    """When some of the listeners are sent events, and up to which."""

    def __init__(self, events: EventLog, made: dict[int, tuple[int, bytes]], pace_s: float) -> None:
        self._events, self._made, self._pace_s = events, made, pace_s
        self.listeners = 0
        self.sent, self._sent_at, self._due = 0, 0.0, False
        self.news = asyncio.Event()

    @property
    def idle(self) -> bool:
        """Whether somebody listens, and no round is to come."""
        return self.listeners > 0 and not self._due

    def tell_soon(self) -> None:
        """Have a round, not too soon after the one before."""
        if self.idle:
            self._due = True
            loop = asyncio.get_running_loop()
            soonest = self._sent_at + self._pace_s * self.listeners
            loop.call_at(max(loop.time(), soonest), self._tell)

    def _tell(self) -> None:
        self._due = False  # first: what happens from here on is for the next round
        self.sent, self._sent_at = self._events.last, asyncio.get_running_loop().time()
        self._made.clear()
        news, self.news = self.news, asyncio.Event()
        news.set()


class _Stream(EventSourceResponse):
    """Events, where their listener has a place."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send events until the client goes, or 429 or 503."""
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

    Without either, only new ones; 0 replays all that are kept. Numbers start at 1 with the service:
    a number that it has not reached yet is from before a restart, and replays everything. A token
    that is revoked, or a login that ends, ends it. Without events a comment comes every second.
    """
    asked = last_event_id if last_event_id is not None else after
    newest = request.app.state.service.events.last
    start = newest if asked is None else asked
    follow = _follow(request, start if start <= newest else 0)
    return _Stream(follow, ping=86400)  # `_PULSE` replaces its comments


async def _follow(request: Request, number: int) -> AsyncIterator[bytes]:
    feed: Feed = request.app.state.feed
    pace: Pace = request.app.state.pace
    owner, clock = owner_of(request.scope), asyncio.get_running_loop().time
    sent = clock()
    with feed.listening(owner.steers):
        while _may(request):
            looked = clock()
            while (left := looked + LOOK_S - clock()) > 0:
                much = not owner.steers and feed.pending(number, owner.steers) > FEW
                turn = await pace.turn(patient=True) if much else Turn()
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
    """Whether the caller may still do what they might: a token that is revoked ends the stream."""
    identity: Identity | None = request.state.identify(request.headers)
    return identity == request.state.identity

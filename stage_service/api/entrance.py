"""What a request waits for once it is known who sent it: a place, its body, and a turn.

All of it on the event loop. A blackout waits for nothing but the end of its caller's other ones.
"""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from starlette.datastructures import Headers
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from stage_service.api import bodies
from stage_service.api.connections import Connection, connection_of
from stage_service.api.pace import Pace, Paced, Turn
from stage_service.api.places import AGAIN_S, Kind, NoPlace, Owner, Places
from stage_service.api.problems import problem_response

STOP = re.compile(r"POST (?:/devices/blackout|/queue:hold|/captures/([^/]+)/abort)")
"""What darkens. An abort of another capture than the one that is shot darkens nothing."""
EXPRESS = re.compile(
    r"(?:GET|HEAD) (?:/|/health|/login|/docs|/favicon\.ico|/web/.*)|POST /(?:login|logout)"
)
"""What, beside `STOP`, is answered on a connection without a place: the way to the button."""
UPLOAD = re.compile(r"PUT (?:/uploads/|/view/models/).*")
VIEWED = re.compile(r"[A-Z]+ /view/models/.+")
"""What the tracer's process does: it takes no turn, but waits until no capture is shot."""


VIEWED_LATER = (
    "a capture is being shot: until it ends models are shown to tokens with the scope 'steer' "
    "alone; try again after it"
)


class Entrance:
    """Lets requests in whose callers have a place, with their body read, and refuses the others.

    `running()` is the id of the capture that is shot.
    """

    def __init__(self, app: ASGIApp, running: Callable[[], str | None]) -> None:
        self._app, self._running = app, running

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or refuse it with 400, 408, 413, 429 or 503."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        with _holding(scope) as held:
            try:
                refusal = await self._enter(held, scope, receive, send)
            except (NoPlace, Paced) as error:
                refusal = no_place(scope, error)
            except bodies.TooSlow as error:
                refusal = problem_response(scope["path"], "http", str(error), status=408)
            except bodies.TooLarge as error:
                refusal = problem_response(scope["path"], "too-large", str(error))
            except bodies.Left:
                return
            if refusal is not None:
                await _refuse(refusal, scope, receive, send, held)

    async def _enter(
        self, held: _Held, scope: Scope, receive: Receive, send: Send
    ) -> Response | None:
        asked, owner = f"{scope['method']} {scope['path']}", held.owner
        connection, stop = connection_of(scope), STOP.fullmatch(asked)
        if connection is not None:
            try:
                connection.own(owner)
            except NoPlace:
                if stop is None and EXPRESS.fullmatch(asked) is None:
                    raise
                send = _closing(send)
        headers, upload = Headers(scope=scope), UPLOAD.fullmatch(asked) is not None
        if stop is not None and stop[1] in (None, self._running()):
            await held.wait("stops")  # which has no body, and waits for none
            await self._app(scope, bodies.again(b"", receive), held.sending(send))
            return None
        if upload:
            await held.wait("uploads")
            most, within_s = bodies.MOST_UPLOAD, bodies.UPLOAD_S
        else:
            most = bodies.MOST_BODY if owner.steers else bodies.MOST_OTHERS
            within_s = bodies.BODY_S
        body = await bodies.read(headers, receive, most, within_s, held.pause)
        if VIEWED.fullmatch(asked):
            if not owner.steers and self._running() is not None:
                raise Paced(VIEWED_LATER)
            await held.wait("renders")
        elif not (owner.steers and scope["path"] == "/health"):
            await held.wait("requests")
            await held.turn()
        if not upload and (wrong := bodies.not_json(headers, body)) is not None:
            errors = [{"loc": "", "msg": wrong}]
            return problem_response(scope["path"], "invalid-request", wrong, errors=errors)
        await self._app(scope, bodies.again(body, receive), held.sending(send))
        return None


async def answer(response: Response, scope: Scope, receive: Receive, send: Send) -> None:
    """Send a refusal to somebody who has no place, in their turn: refusing costs something, too."""
    with _holding(scope) as held:
        try:
            await held.wait("requests")
            await held.turn()
        except (NoPlace, Paced) as error:
            response = no_place(scope, error)
        await _refuse(response, scope, receive, send, held)


class _Held:
    """What one request holds, until its answer begins; its upload's place until the end."""

    def __init__(self, scope: Scope) -> None:
        self.owner = owner_of(scope)
        self._places: Places = scope["app"].state.places
        self._pace: Pace = scope["app"].state.pace
        self._connection = connection_of(scope)
        self._kinds: list[Kind] = []
        self._turn = Turn()

    async def wait(self, kind: Kind) -> None:
        """Take a place. Raises `NoPlace`."""
        with _parked(self._connection):
            await self._places.wait(kind, self.owner)
        self._kinds.append(kind)

    async def turn(self) -> None:
        """Wait for a turn, unless the caller may steer. Raises `Paced`."""
        if not self.owner.steers:
            with _parked(self._connection):
                self._turn = await self._pace.turn()

    async def pause(self) -> None:
        """Wait between two parts of a body, each of up to 64 KiB, for a turn's length."""
        if not self.owner.steers:
            (await self._pace.turn(patient=True)).end()

    def sending(self, send: Send) -> Send:
        """`send`, which gives all but an upload's place back when the answer begins."""

        async def sending(message: Message) -> None:
            self.leave(keep="uploads")
            await send(message)

        return sending

    def leave(self, keep: str = "") -> None:
        """Give back what is held, but for one kind."""
        self._turn.end()
        for kind in [k for k in self._kinds if k != keep]:
            self._kinds.remove(kind)
            self._places.leave(kind, self.owner)


def owner_of(scope: Scope) -> Owner:
    """Whose places a request takes."""
    return Owner.of(scope.get("state", {}).get("identity"), scope.get("client"))


@contextmanager
def _holding(scope: Scope) -> Iterator[_Held]:
    """What a request holds, given back at the block's end; which a client that has left ends."""
    held, connection = _Held(scope), connection_of(scope)
    try:
        yield held
    except asyncio.CancelledError:
        if connection is None or not connection.gone:
            raise
    finally:
        held.leave()


@contextmanager
def _parked(connection: Connection | None) -> Iterator[None]:
    """The connection may make room meanwhile, and its end ends the waiting."""
    if connection is None:
        yield
        return
    connection.parked = asyncio.current_task()
    try:
        yield
    finally:
        connection.parked = None


def no_place(scope: Scope, error: NoPlace | Paced) -> Response:
    """The refusal of somebody who has no place, or no turn."""
    response = problem_response(scope["path"], "no-place", str(error), status=error.status)
    response.headers["retry-after"] = str(AGAIN_S)
    return response


async def _refuse(
    response: Response, scope: Scope, receive: Receive, send: Send, held: _Held
) -> None:
    response.headers["connection"] = "close"
    headers, sending = Headers(scope=scope), held.sending(send)
    await response(scope, receive, bodies.lingering(headers, receive, sending, held.pause))


def _closing(send: Send) -> Send:
    """`send`, with which the connection is closed after the answer."""

    async def closing(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = [*message.get("headers", []), (b"connection", b"close")]
            message = {**message, "headers": headers}
        await send(message)

    return closing

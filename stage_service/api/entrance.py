"""What a request waits for after authentication: a place, its body, and a turn.

All on the event loop. A blackout waits only for the end of its caller's other blackouts.
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
from stage_service.api.places import AGAIN_S, Kind, NoPlace, Owner, Places
from stage_service.api.problems import problem_response
from stage_service.api.throttle import Throttle, Throttled, Turn

STOP = re.compile(r"POST (?:/devices/blackout|/queue:hold|/captures/([^/]+)/abort)")
"""Requests that darken the stage, if an abort names the running capture."""
EXPRESS = re.compile(
    r"(?:GET|HEAD) (?:/|/health|/login|/docs|/favicon\.ico|/web/.*)|POST /(?:login|logout)"
)
"""Other requests that need no connection place: the way to the blackout button."""
UPLOAD = re.compile(r"PUT (?:/uploads/|/view/models/).*")
VIEWED = re.compile(r"[A-Z]+ /view/models/.+")
"""Requests to the tracer's process: they take no turn, and wait until no capture runs."""


VIEWED_LATER = (
    "a capture is running: until its end models are shown only to tokens with the scope 'steer'; "
    "try again after it"
)


class Entrance:
    """Passes on requests whose callers have a place, with their body read, and refuses others.

    `running()` is the id of the running capture.
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
            except (NoPlace, Throttled) as error:
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
        request, owner = f"{scope['method']} {scope['path']}", held.owner
        connection, stop = connection_of(scope), STOP.fullmatch(request)
        if connection is not None:
            try:
                connection.own(owner)
            except NoPlace:
                if stop is None and EXPRESS.fullmatch(request) is None:
                    raise
                send = _closing(send)
        headers, upload = Headers(scope=scope), UPLOAD.fullmatch(request) is not None
        if stop is not None and stop[1] in (None, self._running()):
            await held.wait("stops")  # it has no body to wait for
            await self._app(scope, bodies.again(b"", receive), held.sending(send))
            return None
        if upload:
            await held.wait("uploads")
            most, within_s = bodies.MOST_UPLOAD, bodies.UPLOAD_S
        else:
            most = bodies.MOST_BODY if owner.steers else bodies.MOST_OTHERS
            within_s = bodies.BODY_S
        body = await bodies.read(headers, receive, most, within_s, held.pause)
        if VIEWED.fullmatch(request):
            if not owner.steers and self._running() is not None:
                raise Throttled(VIEWED_LATER)
            await held.wait("renders")
        elif not (owner.steers and scope["path"] == "/health"):
            await held.wait("requests")
            await held.turn()
        if not upload and (wrong := bodies.not_json(headers, body)) is not None:
            errors = [{"loc": "", "msg": wrong}]
            return problem_response(scope["path"], "invalid-request", wrong, errors=errors)
        await self._app(scope, bodies.again(body, receive), held.sending(send))
        return None


async def refuse(response: Response, scope: Scope, receive: Receive, send: Send) -> None:
    """Send a refusal in the caller's turn, because refusals cost time too."""
    with _holding(scope) as held:
        try:
            await held.wait("requests")
            await held.turn()
        except (NoPlace, Throttled) as error:
            response = no_place(scope, error)
        await _refuse(response, scope, receive, send, held)


class _Held:
    """Places and turn of a request until its response begins; an upload's place until its end."""

    def __init__(self, scope: Scope) -> None:
        self.owner = owner_of(scope)
        self._places: Places = scope["app"].state.places
        self._throttle: Throttle = scope["app"].state.throttle
        self._connection = connection_of(scope)
        self._kinds: list[Kind] = []
        self._turn = Turn()

    async def wait(self, kind: Kind) -> None:
        """Take a place. Raises `NoPlace`."""
        with _parked(self._connection):
            await self._places.wait(kind, self.owner)
        self._kinds.append(kind)

    async def turn(self) -> None:
        """Wait for a turn. Raises `Throttled`."""
        with _parked(self._connection):
            self._turn = await self._throttle.turn(self.owner)

    async def pause(self) -> None:
        """Wait between two parts of a body, of up to 64 KiB each, for a turn."""
        (await self._throttle.turn(self.owner, patient=True)).end()

    def sending(self, send: Send) -> Send:
        """`send`, which frees all but an upload's place when the response begins."""

        async def sending(message: Message) -> None:
            self.leave(keep="uploads")
            await send(message)

        return sending

    def leave(self, keep: str = "") -> None:
        """Free all places but those of kind `keep`, and end the turn."""
        self._turn.end()
        for kind in [k for k in self._kinds if k != keep]:
            self._kinds.remove(kind)
            self._places.leave(kind, self.owner)


def owner_of(scope: Scope) -> Owner:
    """The owner of a request's places."""
    return Owner.of(scope.get("state", {}).get("identity"), scope.get("client"))


@contextmanager
def _holding(scope: Scope) -> Iterator[_Held]:
    """Places and turn of a request, freed at the block's end, which a leaving client ends."""
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
    """Let the connection make room meanwhile; its end cancels the waiting."""
    if connection is None:
        yield
        return
    connection.parked = asyncio.current_task()
    try:
        yield
    finally:
        connection.parked = None


def no_place(scope: Scope, error: NoPlace | Throttled) -> Response:
    """The refusal of a caller without a place or a turn."""
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
    """`send`, which closes the connection after the response."""

    async def closing(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = [*message.get("headers", []), (b"connection", b"close")]
            message = {**message, "headers": headers}
        await send(message)

    return closing

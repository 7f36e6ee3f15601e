"""What a request passes before a route sees it: whom it is for, who sent it, how large it is.

All of it on the event loop, so that a blackout waits for no thread here.
"""

from __future__ import annotations

import asyncio
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from reconstruction.reading import parse_json
from stage_service.api.login import cookies, place
from stage_service.api.problems import problem_response
from stage_service.api.scopes import Route, route_of
from stage_service.api.steering import RIGHT
from stage_service.records.attempts import Attempts
from stage_service.records.logins import Logins
from stage_service.records.refusals import Refusals
from stage_service.records.tokens import SCOPES, Identity, Tokens, UnknownToken

OWN_NAMES = frozenset({"127.0.0.1", "localhost", "[::1]"})
VIEW, VIEW_PAGE = "/view", "/view/page/"
ANYBODY = Identity(name="", scopes=SCOPES)
DARK = ("POST", "/devices/blackout")
"""The one request that a page's right to a blackout opens."""
NAMES = {"/devices/blackout": "blackout", "/login": "login"}
"""What the audit log calls them, refused or not."""
MOST_BODY = 1 << 20
BODY_S = 20.0
"""A request's body is there within this time."""
LINGER_S = 10.0
"""How long a request that is refused may go on sending."""
UPLOADS, MOST_UPLOAD, UPLOAD_S = ("/uploads/", f"{VIEW}/models/"), 32 << 20, 120.0
"""Where a `PUT` may be larger, and take longer: two at a time, each of them in memory."""


@dataclass(frozen=True)
class Access:
    """Who gets in: by host names that are this service's (in lower case), and by `tokens`, sent
    with each request or once to log in; None: everybody."""

    tokens: Tokens | None = None
    names: frozenset[str] = OWN_NAMES
    logins: Logins = field(default_factory=Logins)
    attempts: Attempts = field(default_factory=Attempts)

    def refusal(self, headers: Headers) -> tuple[str, str, int | None] | None:
        """Why a browser may have been made to send this, as a problem's kind, detail, status.

        The listener takes connections from this machine alone, as a rule; but a web page from
        elsewhere, open in a browser here, can post to it, or point its own host name at it.
        """
        host = headers.get("host", "")
        if _name(host).lower() not in self.names:
            return "http", f"host {host!r} is not a name of this service", 421
        own = {f"{scheme}://{host}" for scheme in ("http", "https")}
        for origin in headers.getlist("origin"):
            if origin not in own:
                return "foreign-origin", f"a page of {origin!r} may not ask this service", None
        return None

    def identity(self, headers: Headers, secure: bool = False) -> Identity | None:
        """Who asks, over TLS where `secure`; a token that is sent counts alone, not the cookie
        beside it. Of several cookies the first good one counts."""
        if self.tokens is None:
            return ANYBODY
        if "authorization" in headers:
            kind, _, token = headers["authorization"].partition(" ")
            return self.tokens.find(token.strip()) if kind.lower() == "bearer" else None
        behind = self.logins.tokens_of(cookies(headers, secure), place(headers))
        return next(filter(None, map(self.tokens.behind, behind)), None)

    def darkens(self, headers: Headers) -> Identity | None:
        """Who may black out, and nothing else, by what a page keeps of an earlier login; asks no
        disk."""
        name = self.logins.blackout_by(headers.get(RIGHT, ""))
        return None if name is None else Identity(name=f"{name}, blackout right", scopes=())

    def of_token(self, token: str) -> Identity:
        """Whose token this is. Raises `UnknownToken`."""
        identity = ANYBODY if self.tokens is None else self.tokens.find(token)
        if identity is None:
            raise UnknownToken("there is no such token; 'hairstage token' shows and makes them")
        return identity


class Gate:
    """Passes on what `access` lets in, with its body read; the caller is `identity` in the scope's
    state. All else is answered with a problem document."""

    def __init__(self, app: ASGIApp, access: Access, refusals: Refusals | None = None) -> None:
        self._app, self._access, self._refusals = app, access, refusals
        self._uploads = asyncio.Semaphore(2)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or refuse it."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        route = route_of(scope["method"], scope["path"])
        darkens = route is not None and (route.method, route.path) == DARK
        state = scope.setdefault("state", {})
        refusal = self._access.refusal(headers) or self._scope_refusal(scope, route, darkens)
        if refusal is None and darkens:  # which has no body, and waits for none
            await self._app(scope, receive, send)
        elif refusal is None:
            upload = scope["method"] == "PUT" and scope["path"].startswith(UPLOADS)
            async with self._uploads if upload else nullcontext():
                refusal = await self._with_body(scope, receive, send, upload)
        if refusal is None:
            if found := state.get("refusal"):
                self._record(scope, route, *found)
            return
        slug, detail, status = refusal
        self._record(scope, route, slug, detail)
        if darkens:
            why = "Log in again" if slug == "unauthorized" else detail
            detail = f"{why}. The stage was NOT darkened: press the wired emergency stop."
        more = {"scope": route.scopes[0]} if slug == "forbidden" and route and route.scopes else {}
        response = problem_response(scope["path"], slug, detail, status=status, **more)
        response.headers["connection"] = "close"
        if slug == "unauthorized":
            response.headers["www-authenticate"] = "Bearer"
        await response(scope, receive, _lingering(headers, receive, send))

    def _scope_refusal(
        self, scope: Scope, route: Route | None, darkens: bool
    ) -> tuple[str, str, int | None] | None:
        """Why whoever asks may not; who it is stands in the scope's state from here on."""
        headers = Headers(scope=scope)
        identify = partial(self._access.identity, secure=scope["scheme"] == "https")
        identity = identify(headers)
        if identity is None and darkens:
            identity = self._access.darkens(headers)
        scope["state"] |= {"identity": identity, "identify": identify}
        if route is not None and route.open:
            return None
        if identity is None:
            detail = (
                "log in again: the request has neither the header 'Authorization: Bearer TOKEN' "
                "with a token that is known here, nor the cookie of a login that is not over"
            )
            return "unauthorized", detail, None
        if route is not None and route.scopes and not route.allows(identity.scopes):
            needed = " or ".join(map(repr, route.scopes))
            return "forbidden", f"this needs a token with the scope {needed}", None
        return None

    def _record(self, scope: Scope, route: Route | None, slug: str, detail: str) -> None:
        """Have the audit log name who was refused what, where it matters who tried."""
        if self._refusals is None or route is None or not route.audited:
            return
        identity, client = scope["state"].get("identity"), scope.get("client")
        self._refusals.note(
            identity.name if identity is not None else "",
            f"{client[0]}:{client[1]}" if client else "this machine",
            NAMES.get(route.path, f"{route.method} {route.path}"),
            scope["path"],
            slug,
            detail,
        )

    async def _with_body(
        self, scope: Scope, receive: Receive, send: Send, upload: bool
    ) -> tuple[str, str, int | None] | None:
        """Read the body and pass the request on; returns why that was not done."""
        headers = Headers(scope=scope)
        most, within_s = (MOST_UPLOAD, UPLOAD_S) if upload else (MOST_BODY, BODY_S)
        try:
            async with asyncio.timeout(within_s):
                body = await _body(headers, receive, most)
        except TimeoutError:
            return "http", f"the request was not there within {within_s:g} s", 408
        except OverflowError:
            return "too-large", f"a request has at most {most:,} bytes", None
        wrong = None if upload else _not_json(headers, body)
        if wrong is None:
            await self._app(scope, _again(body, receive), send)
        else:
            told = [{"loc": "", "msg": wrong}]
            answer = problem_response(scope["path"], "invalid-request", wrong, errors=told)
            await answer(scope, receive, send)
        return None


async def _body(headers: Headers, receive: Receive, most: int) -> Message:
    """The whole body as one message. Raises `OverflowError`; a client that has gone is one, too."""
    length = headers.get("content-length", "")
    if length.isdigit() and int(length) > most:
        raise OverflowError
    body = bytearray()
    while True:
        message = await receive()
        if message["type"] != "http.request":
            return message
        body += message.get("body", b"")
        if len(body) > most:
            raise OverflowError
        if not message.get("more_body", False):
            return {"type": "http.request", "body": bytes(body), "more_body": False}


def _lingering(headers: Headers, receive: Receive, send: Send) -> Send:
    """Sends an answer, then takes and forgets what the client still sends before the last word.

    A connection that is closed with unread bytes is reset, and the answer is lost with it.
    """

    async def rest() -> None:
        while True:
            message = await receive()
            if message["type"] != "http.request" or not message.get("more_body", False):
                return

    async def send_then_wait(message: Message) -> None:
        last = message["type"] == "http.response.body" and not message.get("more_body", False)
        if last and "expect" not in headers:  # who expects to be asked sends nothing yet
            await send({**message, "more_body": True})
            with suppress(TimeoutError):
                async with asyncio.timeout(LINGER_S):
                    await rest()
            message = {"type": "http.response.body", "body": b""}
        await send(message)

    return send_then_wait


def _not_json(headers: Headers, message: Message) -> str | None:
    """Why a body that calls itself JSON, or nothing at all, cannot be read as such."""
    kind = headers.get("content-type", "json").partition(";")[0].strip().lower()
    if not message.get("body") or not kind.endswith("json"):
        return None
    try:
        parse_json(message["body"])
    except ValueError as error:
        return f"the body is not JSON: {error}"
    return None


def _again(message: Message, receive: Receive) -> Receive:
    """Gives the message that was read already, then what comes."""
    waiting: list[Any] = [message]

    async def next_message() -> Message:
        return waiting.pop() if waiting else await receive()

    return next_message


def _name(host: str) -> str:
    name, _, port = host.rpartition(":")
    return name if port.isdigit() else host

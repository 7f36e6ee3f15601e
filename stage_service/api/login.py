"""Logins: a browser gives a token once, and then sends a cookie that no page's script can read."""

from __future__ import annotations

import asyncio
from concurrent.futures import Future
from contextlib import suppress
from typing import Annotated

from fastapi import APIRouter, Request, Response
from pydantic import BaseModel, ConfigDict, Field
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers

from stage_service.api.problems import problem_response
from stage_service.api.steering import RIGHT, Anybody, OnService, address_of
from stage_service.captures import control
from stage_service.captures.control import Caller
from stage_service.records import logins
from stage_service.records.tokens import Identity, Scope, UnknownToken

LOGIN = "/login"


class LoginRequest(BaseModel):
    """A token, as `hairstage token` makes and shows them."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    token: Annotated[str, Field(min_length=1, max_length=200)]


class Who(BaseModel):
    """Whose token it is ("" where nobody needs one), and what it opens; `blackout` is what a page
    sends as the header `Hairstage-Blackout` to darken the stage whatever becomes of its login."""

    name: str
    scopes: tuple[Scope, ...]
    blackout: str | None


open_to_all = APIRouter(tags=["login"])
router = APIRouter(tags=["login"])


@open_to_all.post(LOGIN)
async def log_in(
    body: LoginRequest, request: Request, response: Response, service: OnService
) -> Who:
    """Log a browser in by a token, for 12 hours. The cookie stands for the token; it is sent to
    this service alone, by its own pages alone, and no script reads it. After some wrong tokens the
    next login from that address is refused for a while (429, `Retry-After`)."""
    access = request.app.state.access
    if access.tokens is None:
        return _who(request, access.of_token(body.token))
    origin = _origin(request)
    access.attempts.check(origin)
    try:
        identity: Identity = access.of_token(body.token)
    except UnknownToken:
        access.attempts.failed(origin)
        raise
    held = access.logins.begin(body.token, place(request.headers))
    response.headers["Set-Cookie"] = _cookie(request, held, logins.LASTS_S)
    by = Caller(address_of(request), name=identity.name, scopes=identity.scopes)
    await _recorded(service.record_login(by, "login"))
    return _who(request, identity)


@router.get(LOGIN)
async def who(request: Request, by: Anybody) -> Who:
    """Whom the service takes the caller for, by token or cookie, and what that opens."""
    return _who(request, by)


@router.post("/logout", response_model=Who)
async def log_out(
    request: Request, response: Response, by: Anybody, service: OnService
) -> Who | Response:
    """End the login: its cookie opens nothing any more, whoever kept it. The right to a blackout
    stays."""
    access, held = request.app.state.access, cookies(request.headers, _secure(request))
    answer: Who | Response = _who(request, by)
    try:
        await run_in_threadpool(access.logins.end, held, place(request.headers))
    except logins.NotStored as error:
        answer = response = problem_response(request.url.path, "not-stored", str(error))
    await _recorded(service.record_login(by, "logout"))
    response.headers["Set-Cookie"] = _cookie(request, "", 0)
    return answer


async def _recorded(line: Future[None]) -> None:
    """Wait for the line, as everybody does, without a thread."""
    with suppress(TimeoutError):
        await asyncio.wait_for(asyncio.shield(asyncio.wrap_future(line)), control.RECORDED_S)


def _origin(request: Request) -> str:
    """What wrong logins are counted by: the page, where its right to a blackout shows that it has
    once logged in, so that no other program at its address keeps it out; else the address."""
    name = request.app.state.access.logins.blackout_by(request.headers.get(RIGHT, ""))
    host = request.client.host if request.client else "this machine"
    return host if name is None else f"a page of {name}"


def place(headers: Headers) -> str:
    """Host and port that a request names, to which a login is bound: a browser sends the cookies of
    one port to all others of the host."""
    return headers.get("host", "").lower()


def cookies(headers: Headers, secure: bool) -> list[str]:
    """What the login cookies of a request hold, as they came: another port of the host may have set
    one of the same name, with a longer path, which comes first."""
    name = _name(headers, secure)
    parts = [part.strip() for line in headers.getlist("cookie") for part in line.split(";")]
    return [value for part in parts for key, _, value in [part.partition("=")] if key == name]


def _who(request: Request, by: Caller | Identity) -> Who:
    access = request.app.state.access
    right = None if access.tokens is None else access.logins.blackout_right(by.name)
    return Who(name=by.name, scopes=by.scopes, blackout=right)


def _cookie(request: Request, held: str, seconds: float) -> str:
    """`Set-Cookie`; an empty one takes it back."""
    over_tls = "; Secure" if _secure(request) else ""
    rules = f"Path=/; Max-Age={seconds:.0f}; HttpOnly; SameSite=Strict{over_tls}"
    return f"{_name(request.headers, _secure(request))}={held}; {rules}"


def _name(headers: Headers, secure: bool) -> str:
    """The cookie's. Over TLS a browser takes `__Host-` from this very host alone, and for TLS; the
    port is in it, as a browser does not keep those of two ports of one host apart."""
    port = headers.get("host", "").rpartition(":")[2]
    name = f"hairstage-{port}" if port.isdigit() else "hairstage"
    return f"__Host-{name}" if secure else name


def _secure(request: Request) -> bool:
    return request.url.scheme == "https"

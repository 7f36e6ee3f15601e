"""Logins: a browser sends a token once, then a cookie that scripts cannot read."""

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
PAGE_PATH = "Hairstage-Path"
"""The header with the path of the page that logs in."""


class LoginRequest(BaseModel):
    """A token, see `hairstage token`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    token: Annotated[str, Field(min_length=1, max_length=200)]


class Who(BaseModel):
    """The token's name ("" if none is required) and scopes; a page sends `blackout` as the header
    `Hairstage-Blackout` to black out the stage even after its login has ended."""

    name: str
    scopes: tuple[Scope, ...]
    blackout: str | None


open_to_all = APIRouter(tags=["login"])
router = APIRouter(tags=["login"])


@open_to_all.post(LOGIN, response_model=Who)
async def log_in(
    body: LoginRequest, request: Request, response: Response, service: OnService
) -> Who | Response:
    """Log a browser in by a token, for 12 hours. The cookie represents the token; only this
    service's pages send it, and scripts cannot read it. After several wrong tokens further logins
    from that address are refused for some time (429, `Retry-After`)."""
    access = request.app.state.access
    here = f"{access.prefix}/"
    if (opened := request.headers.get(PAGE_PATH, here)) != here:
        option = f"with --root-path {opened[:-1]}" if opened != "/" else "without --root-path"
        detail = (
            f"this page was opened at the path {opened!r}, but the service is at {here!r}: open it "
            f"there, or start 'hairstage serve' {option}"
        )
        return problem_response(request.url.path, "http", detail, status=421)
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
    """The caller's name and scopes, by token or cookie."""
    return _who(request, by)


@router.post("/logout", response_model=Who)
async def log_out(
    request: Request, response: Response, by: Anybody, service: OnService
) -> Who | Response:
    """End the login and invalidate its cookie. The blackout right stays."""
    access = request.app.state.access
    held = cookies(request.headers, _secure(request), access.prefix)
    result: Who | Response = _who(request, by)
    try:
        await run_in_threadpool(access.logins.end, held, place(request.headers))
    except logins.NotStored as error:
        result = response = problem_response(request.url.path, "not-stored", str(error))
    await _recorded(service.record_login(by, "logout"))
    response.headers["Set-Cookie"] = _cookie(request, "", 0)
    return result


async def _recorded(line: Future[None]) -> None:
    """Wait for the audit log's line without a thread."""
    with suppress(TimeoutError):
        await asyncio.wait_for(asyncio.shield(asyncio.wrap_future(line)), control.RECORDED_S)


def _origin(request: Request) -> str:
    """What wrong logins are counted by: the page, if its blackout right proves an earlier login, so
    that other programs at its address cannot lock it out; else the address."""
    name = request.app.state.access.logins.blackout_by(request.headers.get(RIGHT, ""))
    host = request.client.host if request.client else "this machine"
    return host if name is None else f"a page of {name}"


def place(headers: Headers) -> str:
    """Host and port of a request, to which a login is bound: browsers share cookies between
    ports."""
    return headers.get("host", "").lower()


def cookies(headers: Headers, secure: bool, prefix: str) -> list[str]:
    """Values of a request's login cookies, in order: another port of the host may have set one of
    the same name with a longer path, which comes first."""
    name = _name(headers, secure, prefix)
    parts = [part.strip() for line in headers.getlist("cookie") for part in line.split(";")]
    return [value for part in parts for key, _, value in [part.partition("=")] if key == name]


def _who(request: Request, by: Caller | Identity) -> Who:
    access = request.app.state.access
    right = None if access.tokens is None else access.logins.blackout_right(by.name)
    return Who(name=by.name, scopes=by.scopes, blackout=right)


def _cookie(request: Request, held: str, seconds: float) -> str:
    """`Set-Cookie`; an empty value removes the cookie."""
    over_tls = "; Secure" if _secure(request) else ""
    rules = f"Path=/; Max-Age={seconds:.0f}; HttpOnly; SameSite=Strict{over_tls}"
    prefix = request.app.state.access.prefix
    return f"{_name(request.headers, _secure(request), prefix)}={held}; {rules}"


def _name(headers: Headers, secure: bool, prefix: str) -> str:
    """The cookie's name, with port and path prefix, because browsers share cookies between ports.
    Over TLS it begins with `__Host-`, which binds it to this host."""
    port = headers.get("host", "").rpartition(":")[2]
    name = f"hairstage-{port}" if port.isdigit() else "hairstage"
    name += prefix.replace("/", ".")
    return f"__Host-{name}" if secure else name


def _secure(request: Request) -> bool:
    return request.url.scheme == "https"

"""Logins: a browser gives a token once, and then sends a cookie that no page's script can read."""

from __future__ import annotations

import secrets
import threading
import time
from collections import OrderedDict
from typing import Annotated

from fastapi import APIRouter, Request, Response
from pydantic import BaseModel, ConfigDict, Field
from starlette.datastructures import Headers

from stage_service.api.steering import Anybody, OnService
from stage_service.records.tokens import Identity, Scope, hashed

LASTS_S = 12 * 3600.0
"""A day's work at the stage."""
MOST_LOGINS = 1000
LOGIN = "/login"


class Logins:
    """Who has logged in, for `LASTS_S` at most; a restart, or `MOST_LOGINS` newer ones, end it.

    What the cookie holds is no token: it opens nothing once its login has ended, here, and tells
    nobody the token. A login opens what its token opens now, so nothing once that is revoked.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._begun: OrderedDict[str, tuple[str, float]] = OrderedDict()

    def begin(self, token: str) -> str:
        """Log in by a token, which was found good; returns what the cookie is to hold."""
        held = secrets.token_urlsafe(32)
        with self._lock:
            self._begun[hashed(held)] = hashed(token), time.monotonic() + LASTS_S
            while len(self._begun) > MOST_LOGINS:
                self._begun.popitem(last=False)
        return held

    def token_of(self, headers: Headers) -> str | None:
        """The hash of the token that a request's cookie stands for."""
        with self._lock:
            token, until = self._begun.get(_held(headers), ("", 0.0))
        return token if time.monotonic() < until else None

    def end(self, headers: Headers) -> None:
        """Log out."""
        with self._lock:
            self._begun.pop(_held(headers), None)


class LoginRequest(BaseModel):
    """A token, as `hairstage token` makes and shows them."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    token: Annotated[str, Field(min_length=1, max_length=200)]


class Who(BaseModel):
    """Whose token it is ("" where nobody is asked for one), and what it opens."""

    name: str
    scopes: tuple[Scope, ...]


open_to_all = APIRouter(tags=["login"])
router = APIRouter(tags=["login"])


@open_to_all.post(LOGIN)
def log_in(body: LoginRequest, request: Request, response: Response, service: OnService) -> Who:
    """Log a browser in by a token, for 12 hours. The cookie stands for the token; it is sent to
    this service alone, by its own pages alone, and no script reads it."""
    access = request.app.state.access
    identity: Identity = access.of_token(body.token)
    if access.tokens is not None:
        response.headers["Set-Cookie"] = _cookie(request, access.logins.begin(body.token), LASTS_S)
        service.record_login(identity.name, request.client)
    return Who(name=identity.name, scopes=identity.scopes)


@router.get(LOGIN)
async def who(by: Anybody) -> Who:
    """Whom the service takes the caller for, by token or cookie, and what that opens."""
    return Who(name=by.name, scopes=by.scopes)


@router.post("/logout")
async def log_out(request: Request, response: Response, by: Anybody) -> Who:
    """End the login: its cookie opens nothing any more, whoever kept it."""
    request.app.state.access.logins.end(request.headers)
    response.headers["Set-Cookie"] = _cookie(request, "", 0)
    return Who(name=by.name, scopes=by.scopes)


def _cookie(request: Request, held: str, seconds: float) -> str:
    """`Set-Cookie`; an empty one takes it back."""
    over_tls = "; Secure" if request.url.scheme == "https" else ""
    rules = f"Path=/; Max-Age={seconds:.0f}; HttpOnly; SameSite=Strict{over_tls}"
    return f"{_name(request.headers)}={held}; {rules}"


def _name(headers: Headers) -> str:
    """The cookie's: a browser does not keep those of two ports of one host apart."""
    port = headers.get("host", "").rpartition(":")[2]
    return f"hairstage-{port}" if port.isdigit() else "hairstage"


def _held(headers: Headers) -> str:
    """The hash of what the request's cookie holds."""
    for part in headers.get("cookie", "").split(";"):
        name, _, value = part.strip().partition("=")
        if name == _name(headers):
            return hashed(value)
    return ""

"""Who may call which route: one table, which the gate enforces before it reads a request's body."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import cast

from starlette.routing import compile_path

from stage_service.records.tokens import SCOPES, Scope

TABLE = """
open         GET     / /docs /docs/errors.md /favicon.ico /openapi.json /web/{name}
open         GET     /view /view/page/{file}
open!        POST    /login
    The pages and the API's description hold nothing of a stage. A login is how one gets a scope.
any          GET     /login
any          POST    /logout
any!         POST    /devices/blackout
any!         POST    /captures/{capture}/abort /queue:hold
    Darkness harms nobody, so every token may cause it. A held queue and an aborted capture light
    nothing either; what they held up goes on by `steer`.
read         GET     /health /ready /metrics /rig /events /audit /lease /devices
read         GET     /captures /captures/{capture} /captures/{capture}/steps
read         GET     /captures/{capture}/frames/{step}/{camera}.exr
read         GET     /captures/{capture}/frames/{step}/{camera}.png
read         GET     /captures/{capture}/frames/{step}/{camera}.json
read         GET     /captures/{capture}/archive.tar
read         GET     /captures/{capture}/board/{camera} /calibration /calibration/rig.json
read         GET     /jobs /jobs/{job} /jobs/{job}/report
read         GET     /jobs/{job}/artifacts /jobs/{job}/artifacts/{path:path}
read         GET     /queue /queue/history /uploads /trash /models /models/{model}/archive.tar
read         POST    /plans:validate
read         GET     /view/models /view/models/{name} /view/models/{name}/strands/{which}
read         GET     /view/models/{name}/head /view/models/{name}/confidence
read         GET     /view/models/{name}/lighting /view/models/{name}/table
read         GET     /view/models/{name}/seen/{light} /view/models/{name}/environments/{which}
read         POST    /view/models/{name}/few /view/models/{name}/indirect
read         POST    /view/models/{name}/indirect/view /view/models/{name}/sums/{camera}.png
    A viewer's renders and the light that it bakes show a model and change nothing: who may see the
    model may see it lit. How many at once is a matter of places, not of scopes.
jobs|steer!  PUT     /view/models/{name}/environments/{file}
    A map from elsewhere is decoded by the service: who only looks gives it nothing to decode.
steer!       POST    /captures /captures/{capture}/pause /captures/{capture}/resume /snapshot
    Besides, `arm` with `armed_by`, `jobs` with `pipeline`.
steer!       DELETE  /captures/{capture}
    `admin` for one that completed.
steer!       POST    /queue /queue/{entry}/start /queue:go-on
steer!       PATCH   /queue/{entry}
steer!       DELETE  /queue/{entry}
steer!       POST    /lease
steer!       PATCH   /lease
admin|steer! DELETE  /lease
    One's own by `steer`; with `force`, somebody else's, by `admin`.
steer!       PUT     /uploads/{subject}/head.obj /uploads/{subject}/masks/{camera}.png
steer!       DELETE  /uploads/{subject}
arm!         POST    /devices/acknowledge
jobs!        POST    /jobs /calibration
jobs!        DELETE  /jobs/{job}
admin!       DELETE  /models/{model} /trash
admin!       POST    /trash/{name}/restore
"""
"""Scopes of which a token needs one, method, paths. "any": whatever its scopes; "open": no token is
needed. "!": it logs in, steers, arms, submits, administrates or darkens: a refusal is audited."""


@dataclass(frozen=True)
class Route:
    """A route as the table has it. A caller needs one of `scopes`; None: any token will do."""

    method: str
    path: str
    open: bool
    scopes: tuple[Scope, ...] | None
    audited: bool

    def allows(self, scopes: tuple[Scope, ...]) -> bool:
        """Whether a token with these scopes may call it."""
        return self.scopes is None or not set(self.scopes).isdisjoint(scopes)


def _routes() -> Iterator[tuple[re.Pattern[str], Route]]:
    for line in TABLE.splitlines():
        if not line or line.startswith(" "):
            continue
        who, method, *paths = line.split()
        names = who.rstrip("!").split("|")
        for path in paths:
            assert names in (["any"], ["open"]) or set(names) <= set(SCOPES), line
            scopes = None if names in (["any"], ["open"]) else cast(tuple[Scope, ...], tuple(names))
            found = Route(method, path, names == ["open"], scopes, audited=who.endswith("!"))
            yield compile_path(path)[0], found


ROUTES = tuple(_routes())


def route_of(method: str, path: str) -> Route | None:
    """The route that a request is for; None where there is none."""
    method = "GET" if method == "HEAD" else method
    for pattern, route in ROUTES:
        if route.method == method and pattern.match(path):
            return route
    return None

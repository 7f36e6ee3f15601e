"""Scopes of the routes, enforced by the gate before it reads a request's body."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import cast

from starlette.routing import compile_path

from stage_service.records.tokens import SCOPES, Scope

TABLE = """
open         GET     / /docs /docs/errors.md /favicon.ico /openapi.json /web/{name}
open         GET     /view /view/page/{file}
open!        POST    /login
    The pages and the API's description contain no data of a stage. A login grants scopes.
any          GET     /login
any          POST    /logout
any!         POST    /devices/blackout
any!         POST    /captures/{capture}/abort /queue:hold
    Darkness is safe, so every token may cause it. Resuming a held queue or an aborted capture needs
    `steer`.
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
read         GET     /view/models/{name}/visibility/{light} /view/models/{name}/environments/{which}
read         POST    /view/models/{name}/few /view/models/{name}/indirect/view
read         POST    /view/models/{name}/sums/{camera}.png
    Renders of a viewer change nothing; their number is limited by places, not scopes.
jobs|steer!  PUT     /view/models/{name}/environments/{file}
    The service decodes the map, so `read` does not suffice.
steer!       POST    /captures /captures/{capture}/pause /captures/{capture}/resume /snapshot
    Also `arm` with `armed_by`, `jobs` with `pipeline`.
steer!       DELETE  /captures/{capture}
    `admin` for a completed one.
steer!       POST    /queue /queue/{entry}/start /queue:go-on
steer!       PATCH   /queue/{entry}
steer!       DELETE  /queue/{entry}
steer!       POST    /lease
steer!       PATCH   /lease
admin|steer! DELETE  /lease
    One's own needs `steer`; with `force`, another's, `admin`.
steer!       PUT     /uploads/{subject}/head.obj /uploads/{subject}/masks/{camera}.png
steer!       DELETE  /uploads/{subject}
arm!         POST    /devices/acknowledge
jobs!        POST    /jobs /calibration
jobs!        DELETE  /jobs/{job}
admin!       DELETE  /models/{model} /trash
admin!       POST    /trash/{name}/restore
"""
"""Scopes of which a token needs one, method, paths. "any": a token with any scopes; "open": no
token. "!": refusals are recorded in the audit log."""


@dataclass(frozen=True)
class Route:
    """A route of the table. A caller needs one of `scopes`; None: any token."""

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


@lru_cache(1024)
def route_of(method: str, path: str) -> Route | None:
    """The route of a request; None if there is none."""
    method = "GET" if method == "HEAD" else method
    for pattern, route in ROUTES:
        if route.method == method and pattern.match(path):
            return route
    return None

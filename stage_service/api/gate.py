"""Checks of a request before its route: host, origin, identity and scope.

All on the event loop, so that a blackout waits for no thread here.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from stage_service.api.entrance import refuse
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
PROXY = "A proxy in between has to pass on the Host; for nginx: proxy_set_header Host $http_host;"
DARK = ("POST", "/devices/blackout")
"""The only request allowed by a page's blackout right."""
NAMES = {"/devices/blackout": "blackout", "/login": "login"}
"""Their names in the audit log."""


@dataclass(frozen=True)
class Access:
    """Access by `names`, the service's host names in lower case, and by `tokens`, sent with each
    request or once to log in; None admits everybody. `prefix` is the path, such as "/stage", under
    which a proxy serves it."""

    tokens: Tokens | None = None
    names: frozenset[str] = OWN_NAMES
    logins: Logins = field(default_factory=Logins)
    attempts: Attempts = field(default_factory=Attempts)
    prefix: str = ""

    def inner(self, path: str) -> str:
        """A request's path without the prefix, which a proxy may have removed."""
        rest = path.removeprefix(self.prefix)
        return path if rest[:1] not in ("", "/") else rest or "/"

    def refusal(self, headers: Headers) -> tuple[str, str, int | None] | None:
        """Kind, detail and status of a problem if a foreign web page may have caused the request.

        The service usually listens on this machine only, but a foreign page in a browser here can
        post to it, or resolve its own host name to it.
        """
        host = headers.get("host", "")
        if _name(host).lower() not in self.names:
            return "http", f"host {host!r} is not a name of this service: see --name", 421
        own = {f"{scheme}://{host}" for scheme in ("http", "https")}
        for origin in headers.getlist("origin"):
            if origin not in own:
                detail = (
                    f"requests from pages of {origin!r} are refused, because the request's Host is "
                    f"{host!r}. {PROXY}"
                )
                return "foreign-origin", detail, None
        return None

    def identity(
        self, headers: Headers, secure: bool = False, within_s: float = 0.0
    ) -> Identity | None:
        """The caller, over TLS if `secure`, by tokens that were checked within the last `within_s`
        seconds. A token in the header takes precedence over cookies; of several cookies the first
        valid one counts."""
        if self.tokens is None:
            return ANYBODY
        if "authorization" in headers:
            kind, _, token = headers["authorization"].partition(" ")
            bearer = kind.lower() == "bearer"
            return self.tokens.find(token.strip(), within_s) if bearer else None
        held = cookies(headers, secure, self.prefix)
        behind = self.logins.tokens_of(held, place(headers))
        found = (self.tokens.behind(hash, within_s) for hash in behind)
        return next(filter(None, found), None)

    def darkens(self, headers: Headers) -> Identity | None:
        """The identity of a page's blackout right, kept from an earlier login; reads no disk."""
        name = self.logins.blackout_by(headers.get(RIGHT, ""))
        return None if name is None else Identity(name=f"{name}, blackout right", scopes=())

    def of_token(self, token: str) -> Identity:
        """The identity of a token. Raises `UnknownToken`."""
        identity = ANYBODY if self.tokens is None else self.tokens.find(token)
        if identity is None:
            raise UnknownToken("unknown token: 'hairstage token' lists and makes tokens")
        return identity


class Gate:
    """Passes on requests that `access` allows, with `identity` in the scope's state, and refuses
    others with a problem document."""

    def __init__(self, app: ASGIApp, access: Access, refusals: Refusals | None = None) -> None:
        self._app, self._access, self._refusals = app, access, refusals

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
        if refusal is None:
            await self._app(scope, receive, send)
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
        if slug == "unauthorized":
            response.headers["www-authenticate"] = "Bearer"
        await refuse(response, scope, receive, send)

    def _scope_refusal(
        self, scope: Scope, route: Route | None, darkens: bool
    ) -> tuple[str, str, int | None] | None:
        """Why the caller may not; sets `identity` in the scope's state."""
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
                "with a valid token, nor the cookie of a valid login"
            )
            if route is None:
                detail += f"; there is no path {scope['path']!r}: see --root-path for proxies"
            return "unauthorized", detail, None
        if route is not None and route.scopes and not route.allows(identity.scopes):
            needed = " or ".join(map(repr, route.scopes))
            return "forbidden", f"this needs a token with the scope {needed}", None
        return None

    def _record(self, scope: Scope, route: Route | None, slug: str, detail: str) -> None:
        """Record a refusal in the audit log, for audited routes."""
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


def _name(host: str) -> str:
    name, _, port = host.rpartition(":")
    return name if port.isdigit() else host

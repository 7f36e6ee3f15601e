"""Which waiting connections are admitted, by the head of their first request."""

from __future__ import annotations

import time
from collections.abc import Callable
from email.utils import formatdate
from http import HTTPStatus

from starlette.datastructures import Headers

from stage_service.api.connections import Hall
from stage_service.api.entrance import EXPRESS, STOP
from stage_service.api.gate import Access
from stage_service.api.places import AGAIN_S, Owner
from stage_service.api.porch import Verdict
from stage_service.api.problems import problem_response
from stage_service.api.throttle import Throttled
from stage_service.web.headers import INERT

AT_ONCE, AT_ONCE_PER_S = 40.0, 20.0
"""Connections of one caller who may steer that are admitted at once, and how many more a second. A
browser opens 6."""
CHECKED_S = 0.1
"""Age of the tokens by which a connection is admitted; its requests are checked against new ones.
A check takes a thread, which a busy interpreter is slow to start: too slow for 500 at once."""


class Admission:
    """Judges connections. Requests that darken are admitted at once, and so are the first of a
    caller who may steer (`AT_ONCE`), if the caller has a place or the hall has room; others in
    turn while their owner has a place or needs none, and the hall has room. `running()` is the id
    of the running capture."""

    def __init__(self, access: Access, hall: Hall, running: Callable[[], str | None]) -> None:
        self._access, self._hall, self._running = access, hall, running
        self._left: dict[Owner, tuple[float, float]] = {}

    def judge(self, head: bytes, address: str) -> Verdict:
        """The verdict on a connection that begins with `head`, empty if it is encrypted."""
        method, path, headers = _parsed(head)
        request = f"{method} {self._access.inner(path)}"
        stop = STOP.fullmatch(request)
        stops = stop is not None and stop[1] in (None, self._running())
        identity = self._access.identity(headers, within_s=CHECKED_S)
        if identity is None and stops:
            identity = self._access.darkens(headers)
        owner = Owner.of(identity, (address, 0))
        express = stops or EXPRESS.fullmatch(request) is not None
        return Verdict(
            owner,
            at_once=identity is not None and (stops or (owner.steers and self._first(owner))),
            may=lambda: express or (self._hall.lacks(owner) is None and not self._hall.crowded),
            refusal=lambda: self._refusal(owner, path),
        )

    def _first(self, owner: Owner) -> bool:
        """Whether the caller is within `AT_ONCE`; counts the connection."""
        now = time.monotonic()
        left, since = self._left.get(owner, (AT_ONCE, now))
        left = min(AT_ONCE, left + AT_ONCE_PER_S * (now - since))
        self._left[owner] = max(left - 1, 0.0), now
        return left >= 1 and (self._hall.lacks(owner) is None or not self._hall.crowded)

    def _refusal(self, owner: Owner, path: str) -> bytes:
        """A complete response, 429 or 503."""
        why = self._hall.lacks(owner) or Throttled()
        response = problem_response(path, "no-place", str(why), status=why.status)
        more = {"retry-after": str(AGAIN_S), "connection": "close"}
        response.headers.update({**INERT, **more})
        response.headers["date"] = formatdate(usegmt=True)
        status = f"HTTP/1.1 {why.status} {HTTPStatus(why.status).phrase}\r\n".encode()
        lines = [name + b": " + value + b"\r\n" for name, value in response.raw_headers]
        return b"".join([status, *lines, b"\r\n", bytes(response.body)])


def _parsed(head: bytes) -> tuple[str, str, Headers]:
    """Method, path and headers of a request; the server rejects what cannot be parsed."""
    first, *lines = head.partition(b"\r\n\r\n")[0].split(b"\r\n")
    method, _, target = first.decode("latin-1").partition(" ")
    pairs = (line.partition(b":") for line in lines)
    headers = Headers(raw=[(name.lower(), value.strip()) for name, _, value in pairs])
    return method, target.partition(" ")[0].partition("?")[0], headers

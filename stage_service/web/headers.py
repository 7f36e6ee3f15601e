"""The headers that limit what a browser does with an answer: one table of policies.

`SafeHeaders` puts `INERT` on every answer that names no other policy, so that a new route is safe
without a line of its own. Files that others may have written (models, captures) must not act on
the service's origin: a script there could send requests with the cookie of whoever opened it.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from urllib.parse import quote

from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

Policy = Mapping[str, str]
REVALIDATED = "no-cache"
"""A browser may keep it, and asks each time whether it has changed: for files of the product."""
_EVERYWHERE = {
    "cross-origin-resource-policy": "same-origin",
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
}
_NOTHING = "default-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"

INERT: Policy = {
    **_EVERYWHERE,
    "cache-control": "private, no-store",
    # the style is that of a browser's own view of a picture or of JSON
    "content-security-policy": f"sandbox; {_NOTHING}; style-src 'unsafe-inline'",
}
"""For whatever shows or describes a person or the stage: no browser keeps it; opened by itself it
runs no script, sends no form, has no origin, and is in no frame."""

PAGE: Policy = {
    **_EVERYWHERE,
    "cache-control": REVALIDATED,
    "content-security-policy": (
        f"{_NOTHING}; script-src 'self'; style-src 'self'; connect-src 'self'; "
        "img-src 'self' data: blob:"
    ),
    "cross-origin-opener-policy": "same-origin",
}
"""For the product's own pages, their scripts and styles: nothing inline, nothing from another host,
no page of another host has them in a frame or a handle of their window."""

_BEGINNINGS = {
    "image/jpeg": (b"\xff\xd8\xff", 0),
    "image/png": (b"\x89PNG\r\n\x1a\n", 0),
    "image/webp": (b"WEBP", 8),
}
"""Pictures that are shown in the browser, by the bytes that each has and where."""
_PICTURES = {".jpg": "image/jpeg", ".png": "image/png", ".webp": "image/webp"}
OTHER = "application/octet-stream"


def report_policy(host: str, folder: str) -> Policy:
    """The policy of a model's own page: it shows the pictures of its `folder` (a path on this
    service, escaped, with a slash at its end), and its links download the files beside it.

    `host` is the request's. The page keeps the service's origin, or its pictures would come
    without the login; without scripts, forms and frames it can do nothing with it.
    """
    # a policy has no way to write an IPv6 address: there, all pictures of this service
    pictures = "'self'" if "[" in host else host + folder
    limits = f"{_NOTHING}; style-src 'unsafe-inline'; img-src {pictures} data:"
    policy = f"sandbox allow-same-origin allow-downloads; {limits}"
    return {**INERT, "content-security-policy": policy}


def attachment(name: str) -> str:
    """`Content-Disposition` of a file that is saved under this name, never shown."""
    plain = "".join(c if c.isascii() and c.isprintable() and c not in '"\\%' else "_" for c in name)
    return f"attachment; filename=\"{plain}\"; filename*=UTF-8''{quote(name, safe='')}"


def presented(file: Path) -> tuple[str, dict[str, str]]:
    """The media type and the headers of a file that somebody else may have written.

    Shown in the browser are JSON, and pictures that begin as their name says; all else is saved,
    a file that has just gone, too.
    """
    suffix = file.suffix.lower()
    if suffix == ".json":
        return "application/json", {}
    kind = _PICTURES.get(suffix)
    if kind is not None:
        expected, at = _BEGINNINGS[kind]
        with suppress(FileNotFoundError), file.open("rb") as opened:
            if opened.read(at + len(expected))[at:] == expected:
                return kind, {}
    return OTHER, {"content-disposition": attachment(file.name)}


class SafeHeaders:
    """Adds `INERT` to each answer, where its route has not set a header of that name.

    Only an answer under `REVALIDATED` is kept by a browser, whatever else its route says.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                for name, value in INERT.items():
                    headers.setdefault(name, value)
                if headers["cache-control"] != REVALIDATED:
                    headers["cache-control"] = INERT["cache-control"]
            await send(message)

        await self._app(scope, receive, with_headers)

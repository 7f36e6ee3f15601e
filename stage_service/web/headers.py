"""Security headers of responses: one table of policies.

`SafeHeaders` adds `INERT` to every response without a policy, so new routes are safe by default.
Untrusted files (models, captures) must not act on the service's origin, where a script could send
requests with the reader's cookie.
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
"""The browser may cache it and revalidates each time: for files of the product."""
_EVERYWHERE = {
    "cross-origin-resource-policy": "same-origin",
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
}
_NOTHING = "default-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"

INERT: Policy = {
    **_EVERYWHERE,
    "cache-control": "private, no-store",
    # browsers style their own view of images and JSON
    "content-security-policy": f"sandbox; {_NOTHING}; style-src 'unsafe-inline'",
}
"""For data of persons or the stage: not cached; opened as a page it has no scripts, forms, origin
or frames."""

PAGE: Policy = {
    **_EVERYWHERE,
    "cache-control": REVALIDATED,
    "content-security-policy": (
        f"{_NOTHING}; script-src 'self'; style-src 'self'; connect-src 'self'; "
        "img-src 'self' data: blob:"
    ),
    "cross-origin-opener-policy": "same-origin",
}
"""For the product's own pages, scripts and styles: nothing inline or from other hosts, no access by
pages of other hosts."""

_BEGINNINGS = {
    "image/jpeg": (b"\xff\xd8\xff", 0),
    "image/png": (b"\x89PNG\r\n\x1a\n", 0),
    "image/webp": (b"WEBP", 8),
}
"""Images that the browser may show, by their signature and its offset."""
_PICTURES = {".jpg": "image/jpeg", ".png": "image/png", ".webp": "image/webp"}
OTHER = "application/octet-stream"


def report_policy(host: str, folder: str) -> Policy:
    """The policy of a model's page: it may show images of its `folder` (an escaped path on this
    service that ends with a slash) and download files.

    `host` is the request's. The page keeps the service's origin, so that its images are loaded with
    the login; it has no scripts, forms or frames.
    """
    # a policy cannot contain an IPv6 address: there, all images of this service
    pictures = "'self'" if "[" in host else host + folder
    limits = f"{_NOTHING}; style-src 'unsafe-inline'; img-src {pictures} data:"
    policy = f"sandbox allow-same-origin allow-downloads; {limits}"
    return {**INERT, "content-security-policy": policy}


def attachment(name: str) -> str:
    """`Content-Disposition` of a file that is saved under this name and not shown."""
    plain = "".join(c if c.isascii() and c.isprintable() and c not in '"\\%' else "_" for c in name)
    return f"attachment; filename=\"{plain}\"; filename*=UTF-8''{quote(name, safe='')}"


def presented(file: Path) -> tuple[str, dict[str, str]]:
    """Media type and headers of an untrusted file.

    The browser shows JSON, and images with the signature of their suffix, and saves other files.
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
    """Adds the headers of `INERT` that a route has not set. Only responses under `REVALIDATED` are
    cached."""

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

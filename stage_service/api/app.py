"""The FastAPI application and the server that runs it."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import sys
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from types import FrameType
from typing import Any

import uvicorn
from fastapi import FastAPI
from fastapi.responses import PlainTextResponse

from stage_service.api import (
    calibration,
    event_stream,
    login,
    queueing,
    routes,
    steering,
    store,
    viewing,
)
from stage_service.api.admission import Admission
from stage_service.api.connections import (
    HEADER_S,
    LOOPBACK,
    QUEUED,
    Hall,
    allow_files,
    files_allowed,
    limits,
    listening,
    share,
)
from stage_service.api.downloads import Heads
from stage_service.api.entrance import Entrance
from stage_service.api.gate import OWN_NAMES, Access, Gate
from stage_service.api.lanes import Lanes
from stage_service.api.places import Places
from stage_service.api.porch import Porch
from stage_service.api.prefix import Prefixed
from stage_service.api.problems import PAGE, Faults, Problem, errors_page, install_problems
from stage_service.api.throttle import Throttle
from stage_service.records.refusals import Refusals
from stage_service.service import Service
from stage_service.stopping import Ending
from stage_service.viewer import Viewing
from stage_service.web import pages
from stage_service.web.headers import SafeHeaders

REQUESTS_S = 1
"""Seconds for requests that are under way after everything else has been closed."""
SWITCH_S = 5e-4
"""Python's switch interval in the service. The event loop gives up the interpreter at each accept,
receive and send, and waits for so long for each busy thread; with Python's 5 ms, 500 connections at
once and two archives delay a blackout by seconds."""
THREADS_S = 1.0
"""Seconds after that for their threads and the interpreter's end."""


def create_app(service: Service, access: Access | None = None) -> FastAPI:
    """The application over `service`; starts it, and closes it (lights off) at shutdown.

    Without `access` everybody on this machine has all scopes.
    """

    @contextlib.asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        service.start()
        try:
            yield
        finally:
            service.close()

    access = access or Access()
    app = FastAPI(
        title="hairstage",
        version=version("hairstage"),
        servers=[{"url": access.prefix}] if access.prefix else None,
        summary="Runs a hair light stage and turns its captures into strands and relit hair.",
        lifespan=lifespan,
        docs_url=None,
        redoc_url=None,
        responses={
            "default": {
                "description": "An error, as a problem document (RFC 9457)",
                "content": {"application/problem+json": {"schema": Problem.model_json_schema()}},
            }
        },
    )
    app.state.service, app.state.lanes, app.state.access = service, Lanes(), access
    app.state.feed, app.state.viewing = event_stream.Feed(service.events), service.viewing
    for part in (routes, steering, queueing, store, calibration, event_stream):
        app.include_router(part.reading)
    for more in (routes, steering, queueing, store, calibration, login):
        app.include_router(more.router)
    for shown in (login.open_to_all, pages.router):
        app.include_router(shown)

    @app.get(PAGE, include_in_schema=False)
    def errors() -> PlainTextResponse:
        return PlainTextResponse(errors_page(), media_type="text/markdown")

    return _completed(app, access, service.refusals, lambda: service.running)


def create_viewer(models: Viewing, access: Access) -> FastAPI:
    """The viewer of `models` alone, without a stage."""
    number = version("hairstage")
    app = FastAPI(title="hairstage viewer", version=number, docs_url=None, redoc_url=None)
    app.state.viewing = models
    return _completed(app, access)


def _completed(
    app: FastAPI,
    access: Access,
    refusals: Refusals | None = None,
    running: Callable[[], str | None] = lambda: None,
) -> FastAPI:
    """Add what both applications have: viewer, problem documents, places, gate, safe headers."""
    app.state.places, app.state.throttle = Places(share()), Throttle(lambda: running() is not None)
    app.state.access, app.state.running = access, running
    install_problems(app)
    for part in (viewing.page, viewing.reading, viewing.router):
        app.include_router(part)
    app.add_middleware(Faults)
    app.add_middleware(Heads)
    app.add_middleware(Entrance, running=running)
    app.add_middleware(Gate, access=access, refusals=refusals)
    app.add_middleware(SafeHeaders)  # outside: responses of the gate have them too
    if access.prefix:
        app.add_middleware(Prefixed, access=access)
    return app


class AnnouncingServer(uvicorn.Server):
    """Calls `ready` when it serves; connections come from a `Porch`. After a signal, requests have
    `REQUESTS_S`, then it ends even if something hangs. A second signal ends it at once."""

    def __init__(self, config: uvicorn.Config, app: FastAPI, ready: Callable[[], None]) -> None:
        super().__init__(config)
        self._app, self._ready = app, ready
        self._porch: Porch | None = None
        self._admitting: set[asyncio.Task[object]] = set()
        self.ending: Ending | None = None
        self._not_ended: list[str] = []

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup([])
        state, encrypted = self._app.state, self.config.ssl is not None
        hall: Hall = self.config.http_protocol_class.hall  # type: ignore[attr-defined]
        admission = Admission(state.access, hall, state.running)
        self._porch = Porch(
            admission.judge,
            self._admit,
            lambda: state.running() is not None,
            files_allowed(),
            encrypted=encrypted,
        )
        for listener in sockets or ():
            self._porch.listen(listener, QUEUED)
        self._ready()

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        if self.ending is not None:
            super().handle_exit(sig, frame)
            return
        self.ending = ending = Ending(self._not_ended, self._under_way)
        threading.Thread(target=self._stop, args=(ending, sig), name="stop", daemon=True).start()

    def _stop(self, ending: Ending, sig: int) -> None:
        try:
            self._close()
        finally:
            # `Ending` logs requests that are cut off in one line
            logging.getLogger("uvicorn.error").setLevel(logging.CRITICAL)
            ending.by(REQUESTS_S + THREADS_S)
            super().handle_exit(sig, None)

    def _close(self) -> None:
        """Close what is served, while requests are still processed."""

    def _under_way(self) -> str:
        requests = len(self.server_state.tasks)
        return f"{requests} requests" if requests else ""

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        if self._porch is not None:
            self._porch.close()
        await super().shutdown(sockets)

    def _admit(self, link: socket.socket) -> None:
        task = asyncio.get_running_loop().create_task(self._connect(link))
        self._admitting.add(task)
        task.add_done_callback(self._admitting.discard)

    async def _connect(self, link: socket.socket) -> None:
        """Serve a connection, after the TLS handshake."""
        encryption = self.config.ssl
        with suppress(OSError):  # the client has gone, or does not use TLS
            await asyncio.get_running_loop().connect_accepted_socket(
                self._connection,
                link,
                ssl=encryption,
                ssl_handshake_timeout=HEADER_S if encryption else None,
            )

    def _connection(self) -> asyncio.Protocol:
        made: asyncio.Protocol = self.config.http_protocol_class(  # type: ignore[call-arg]
            config=self.config, server_state=self.server_state, app_state=self.lifespan.state
        )
        return made


class _Server(AnnouncingServer):
    """Puts the lights off at the signal, and serves blackout and health until all is closed."""

    def __init__(
        self, config: uvicorn.Config, app: FastAPI, service: Service, ready: Callable[[], None]
    ) -> None:
        super().__init__(config, app, ready)
        self._service, self._not_ended = service, service.not_ended

    def _close(self) -> None:
        self._service.close()


@dataclass(frozen=True)
class Endpoint:
    """Where a service listens: the Unix socket `socket`, else `host` and `port` (0: any free one),
    with TLS if it has a `certificate` (and its `key`, if in another file)."""

    host: str = LOOPBACK
    port: int = 0
    socket: Path | None = None
    certificate: Path | None = None
    key: Path | None = None

    @property
    def local(self) -> bool:
        """Whether only this machine can reach it."""
        return self.socket is not None or self.name in OWN_NAMES

    @property
    def name(self) -> str:
        """The host as a request names it."""
        return f"[{self.host}]" if ":" in self.host else self.host.lower()

    def url(self, port: int) -> str:
        """Its URL when it listens on `port`."""
        if self.socket is not None:
            return f"unix:{self.socket.resolve()}"
        return f"http{'s' if self.certificate else ''}://{self.name}:{port}"


def serve_viewer(
    models: Viewing, access: Access, port: int, ready: Callable[[str], Any] = lambda _url: None
) -> None:
    """Serve the viewer of `models` to this machine until SIGINT or SIGTERM.

    `ready` is called with the URL when it serves. Raises `OSError` when the port is taken.
    """
    with listening(LOOPBACK, port, None) as listener:
        allow_files()
        url = Endpoint().url(listener.getsockname()[1])
        app = create_viewer(models, access)
        config = uvicorn.Config(
            app,
            log_level="warning",
            access_log=False,
            timeout_graceful_shutdown=REQUESTS_S,
            **limits(app.state.places),
        )
        AnnouncingServer(config, app, lambda: ready(url)).run(sockets=[listener])


def serve(
    service: Service,
    endpoint: Endpoint,
    access: Access,
    ready: Callable[[str], Any] = lambda _url: None,
) -> None:
    """Serve `service` at `endpoint` until SIGTERM or SIGINT.

    `ready` is called with the URL when it serves. Raises `OSError` when the port is taken.
    """
    with listening(endpoint.host, endpoint.port, endpoint.socket) as listener:
        allow_files()
        url = endpoint.url(0 if endpoint.socket else listener.getsockname()[1]) + access.prefix
        app = create_app(service, access)
        config = uvicorn.Config(
            app,
            log_level="warning",
            access_log=False,
            timeout_graceful_shutdown=REQUESTS_S,
            ssl_certfile=endpoint.certificate,
            ssl_keyfile=endpoint.key,
            **limits(app.state.places),
        )
        server = _Server(config, app, service, lambda: ready(url))
        sys.setswitchinterval(SWITCH_S)
        try:
            server.run(sockets=[listener])
        finally:
            service.close()
            if endpoint.socket is not None:
                endpoint.socket.unlink(missing_ok=True)
            if server.ending is not None and server.ending.left:
                server.ending.now()

"""The FastAPI application and the server that runs it on this machine's loopback."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import AsyncIterator, Callable
from importlib.metadata import version
from types import FrameType
from typing import Any

import uvicorn
from fastapi import FastAPI
from fastapi.responses import PlainTextResponse
from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from stage_service.api import event_stream, routes, steering
from stage_service.api.problems import (
    PAGE,
    Problem,
    errors_page,
    install_problems,
    problem_response,
)
from stage_service.service import Service

LOOPBACK = "127.0.0.1"
OWN_NAMES = {"127.0.0.1", "localhost", "[::1]"}


class OnlyThisMachine:
    """Refuses requests to foreign host names.

    The socket takes connections from this machine alone, but a web page from elsewhere, open in a
    browser here, can point its own host name at 127.0.0.1.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or answer 421."""
        if scope["type"] == "http":
            host = Headers(scope=scope).get("host", "")
            name, _, port = host.rpartition(":")
            if (name if port.isdigit() else host) not in OWN_NAMES:
                detail = f"host {host!r} is not this machine's loopback: use http://{LOOPBACK}"
                refusal = problem_response(scope["path"], "http", detail, status=421)
                await refusal(scope, receive, send)
                return
        await self._app(scope, receive, send)


def create_app(service: Service) -> FastAPI:
    """The application over `service`; starts it, and closes it (lights off) at shutdown."""

    @contextlib.asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        service.start()
        try:
            yield
        finally:
            service.close()

    app = FastAPI(
        title="hairstage",
        version=version("hairstage"),
        summary="Runs a hair light stage and turns its captures into strands and relit hair.",
        lifespan=lifespan,
        responses={
            "default": {
                "description": "An error, as a problem document (RFC 9457)",
                "content": {"application/problem+json": {"schema": Problem.model_json_schema()}},
            }
        },
    )
    app.state.service = service
    install_problems(app)
    app.include_router(routes.router)
    app.include_router(steering.router)
    app.include_router(event_stream.router)

    @app.get(PAGE, include_in_schema=False)
    def errors() -> PlainTextResponse:
        return PlainTextResponse(errors_page(), media_type="text/markdown")

    app.add_middleware(OnlyThisMachine)
    return app


class _Server(uvicorn.Server):
    """Puts the lights off at the signal itself, not after the last connection has closed."""

    def __init__(self, config: uvicorn.Config, service: Service, ready: Callable[[], None]) -> None:
        super().__init__(config)
        self._service, self._ready = service, ready

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        threading.Thread(target=self._service.close, name="lights-off").start()
        super().handle_exit(sig, frame)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        self._ready()


def listening(port: int) -> socket.socket:
    """A socket on 127.0.0.1:`port` (0: any free one). Raises `OSError` when the port is taken."""
    # With the protocol named: asyncio sets TCP_NODELAY on what such a socket accepts and no other.
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((LOOPBACK, port))
    except OSError as error:
        listener.close()
        raise OSError(
            f"port {port} on {LOOPBACK} cannot be used ({error.strerror}): is another service "
            "running? choose another with --port"
        ) from error
    return listener


def serve(service: Service, port: int, ready: Callable[[str], Any] = lambda _url: None) -> None:
    """Serve `service` on 127.0.0.1:`port` (0: any free one) until SIGTERM or SIGINT.

    `ready` is told the URL once requests are answered. Raises `OSError` when the port is taken.
    """
    with listening(port) as listener:
        url = f"http://{LOOPBACK}:{listener.getsockname()[1]}"
        config = uvicorn.Config(
            create_app(service), log_level="warning", access_log=False, timeout_graceful_shutdown=3
        )
        try:
            _Server(config, service, lambda: ready(url)).run(sockets=[listener])
        finally:
            service.close()

"""The application on a socket of its own, as the server runs it, with the service at hand."""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import uvicorn
from fastapi import FastAPI
from waiting import until

from stage_service.api.app import AnnouncingServer, create_app
from stage_service.api.connections import limits
from stage_service.api.gate import Access
from stage_service.config import RigFile
from stage_service.service import Service

URL = "http://127.0.0.1"
"""Where `send` sends to."""


class Client(httpx.Client):
    """Asks the application; `service` is behind it."""

    service: Service
    app: FastAPI

    def go_on(self) -> httpx.Response:
        """Read why the queue is held, and say that it may go on."""
        hold = self.get("/queue").json()["hold"]
        return self.post("/queue:go-on", json={"hold": hold["id"] if hold else "none"})


@contextmanager
def serving(
    rig_file: RigFile,
    root: Path,
    access: Access | None = None,
    *,
    all_read: bool = True,
    port: int = 0,
) -> Iterator[Client]:
    """The application, started and closed as the server does; it has read what is on the disk."""
    service = Service(rig_file, root)
    app = create_app(service, access)
    # The socket takes connections before the server does: the first answer comes when it is up.
    with (
        listening_app(app, port) as url,
        Client(base_url=url, timeout=60, trust_env=False) as client,
    ):
        client.service, client.app = service, app
        client.get("/health")
        until(lambda: not (all_read and service.unread))
        yield client


@contextmanager
def listening_app(app: FastAPI, port: int = 0) -> Iterator[str]:
    """The URL of an application on a socket of its own."""
    config = uvicorn.Config(
        app, log_level="critical", timeout_graceful_shutdown=1, **limits(app.state.places)
    )
    server = AnnouncingServer(config, app, lambda: None)
    listener = socket.create_server(("127.0.0.1", port))
    thread = threading.Thread(target=server.run, args=([listener],))
    thread.start()
    try:
        yield f"http://127.0.0.1:{listener.getsockname()[1]}"
    finally:
        server.should_exit = True
        thread.join(60)
        listener.close()


def slug(response: httpx.Response) -> str:
    """What a problem document says is wrong."""
    return str(response.json()["type"]).partition("#")[2]


def send(app: FastAPI, what: str, headers: dict[str, str], **more: Any) -> httpx.Response:
    """The answer to a request like "GET /captures"; of a service that has not started. It comes
    from `host`, and goes to `url`, this machine's where neither is given."""
    method, path = what.split(" ", 1)
    url, client = more.pop("url", URL), (more.pop("host", "127.0.0.1"), 123)

    async def answer() -> httpx.Response:
        transport = httpx.ASGITransport(app, client=client)
        async with httpx.AsyncClient(transport=transport, base_url=url) as http:
            return await http.request(method, path, headers=headers, **more)

    return asyncio.run(answer())


def refused(response: httpx.Response, slug: str, status: int) -> dict[str, Any]:
    """The problem document that a response is, of this kind and status."""
    data: dict[str, Any] = response.json()
    assert (data["type"], response.status_code) == (f"/docs/errors.md#{slug}", status), data
    return data


def routes_of(app: FastAPI) -> list[tuple[str, str]]:
    """Method and path of every route that an application answers."""

    def walk(routes: Any) -> Iterator[tuple[str, str]]:
        for route in routes:
            inner = getattr(route, "original_router", None)
            if inner is not None:
                yield from walk(inner.routes)
                continue
            for method in route.methods - {"HEAD"}:
                yield method, route.path

    return sorted(walk(app.routes))

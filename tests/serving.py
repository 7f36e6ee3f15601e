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

from stage_service.api.app import create_app
from stage_service.api.gate import Access
from stage_service.config import RigFile
from stage_service.service import Service

URL = "http://127.0.0.1"
"""Where `send` sends to."""


class Client(httpx.Client):
    """Asks the application; `service` is behind it."""

    service: Service


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
    # The socket takes connections before the server does: the first answer comes when it is up.
    with (
        listening_app(create_app(service, access), port) as url,
        Client(base_url=url, timeout=60, trust_env=False) as client,
    ):
        client.service = service
        client.get("/health")
        until(lambda: not (all_read and service.unread))
        yield client


@contextmanager
def listening_app(app: FastAPI, port: int = 0) -> Iterator[str]:
    """The URL of an application on a socket of its own."""
    config = uvicorn.Config(app, log_level="critical", ws="none", timeout_graceful_shutdown=1)
    server = uvicorn.Server(config)
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
    """The answer to a request like "GET /captures"; of a service that has not started."""
    method, path = what.split(" ")

    async def answer() -> httpx.Response:
        async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url=URL) as http:
            return await http.request(method, path, headers=headers, **more)

    return asyncio.run(answer())


def refused(response: httpx.Response, slug: str, status: int) -> dict[str, Any]:
    """The problem document that a response is, of this kind and status."""
    data: dict[str, Any] = response.json()
    assert (data["type"], response.status_code) == (f"/docs/errors.md#{slug}", status), data
    return data

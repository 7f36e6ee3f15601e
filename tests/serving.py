"""The application on a socket of its own, as the server runs it, with the service at hand."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import uvicorn
from fastapi import FastAPI
from waiting import until

from stage_service.api.app import create_app
from stage_service.api.gate import Access
from stage_service.config import RigFile
from stage_service.service import Service


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

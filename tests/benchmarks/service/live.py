"""A service on a simulated stage, and what others do to it meanwhile."""

from __future__ import annotations

import contextlib
import select
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any
from uuid import uuid4

import httpx

from stage_service.cli.support.children import Children, own_command
from stage_service.config import RigFile
from stage_service.records.tokens import own_token

FLAT = "benchmarks.service.flat_stage"
"""The module that is a stage without a renderer."""
DEVICES = """[devices.lights]
port = 15020
timeout_s = 5.0
[devices.projectors]
port = "projectors"
timeout_s = 5.0
[devices.trigger]
port = "trigger"
timeout_s = 5.0
[devices.cameras]
port = 15021
timeout_s = 10.0
busy_s = 60.0
readout_s = 0.002
[safety]
living_subject = false
"""
"""Tables of a rig file: the devices of the flat stage, on ports that its service replaces."""
HURRY_S = 300.0
"""Whatever a service is to come to, it has by then, on a busy machine too."""


class Live:
    """One service, begun again where it was killed; `command` runs `hairstage`, or it does.

    `more`: arguments of `hairstage serve`, at every start.
    """

    def __init__(
        self,
        rig: RigFile,
        children: Children,
        root: Path,
        command: Sequence[str] = (),
        more: Sequence[str] = (),
    ) -> None:
        self.rig, self.root, self._children, self._more = rig, root, children, more
        self.kills = self.resent = 0
        self.begin(command)

    def words(self, root: Path) -> list[str]:
        """The arguments of `hairstage` that serve this stage."""
        devices = self.rig.path.parent / "devices.toml"
        words = ("serve", "--json", "--port", "0", "--rig", self.rig.path, *self._more)
        return [str(word) for word in (*words, "--root", root, "--devices", devices)]

    def begin(self, command: Sequence[str] = ()) -> None:
        """Start the service, or start it again."""
        name = f"{self.root.name}-{self.kills}"
        whole = (
            [*command, *self.words(self.root)] if command else own_command(*self.words(self.root))
        )
        self.child: subprocess.Popen[str] = self._children.start(name, whole, pipe=True)
        url = self._children.first_line(name, self.child, HURRY_S)["url"]
        # A connection each: one that waits for its next request makes room where there are many.
        each = httpx.Limits(max_keepalive_connections=0)
        self.http = self.client(url, limits=each)

    def client(self, url: str | httpx.URL, **more: Any) -> httpx.Client:
        """Asks with this user's own token."""
        headers = {"Authorization": f"Bearer {own_token()}"}
        return httpx.Client(base_url=url, headers=headers, timeout=60, trust_env=False, **more)

    def kill(self) -> None:
        """SIGKILL."""
        self.child.send_signal(signal.SIGKILL)
        self.child.wait()
        self.http.close()
        self.kills += 1

    def end(self) -> None:
        """As somebody who stops it."""
        self.http.close()
        self.child.terminate()
        self.child.wait(HURRY_S)

    def call(self, method: str, path: str, body: Any = None) -> Any:
        """The response's JSON; after a 503, as its header says, or a lost connection the request is
        sent again, four times at most, counted in `resent`.

        Raises `httpx.HTTPStatusError`, `httpx.TransportError`.
        """
        headers = {"Idempotency-Key": uuid4().hex} if method == "POST" else {}
        for left in (4, 3, 2, 1, 0):
            try:
                response = self.http.request(method, path, json=body, headers=headers)
            except httpx.TransportError:
                if not left:
                    raise
                pause = 0.1
            else:
                if response.status_code != httpx.codes.SERVICE_UNAVAILABLE or not left:
                    break
                pause = float(response.headers.get("retry-after", 1))
            self.resent += 1
            time.sleep(pause)
        return response.raise_for_status().json()

    def until_done(self, capture: str) -> dict[str, Any]:
        """The capture once it is done."""
        while (status := self.call("GET", f"/captures/{capture}"))["state"] != "done":
            time.sleep(0.1)
        done: dict[str, Any] = status
        return done

    def request(self, path: str) -> bytes:
        """A `GET` as it goes over the wire."""
        token = f"Authorization: Bearer {own_token()}"
        return f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\n{token}\r\n\r\n".encode()

    def stage_pid(self) -> int:
        """The process that is the stage's devices."""
        rig = str(self.rig.path).encode()
        for process in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                words = (process / "cmdline").read_bytes().split(b"\0")
                if rig in words and not {b"simulators", FLAT.encode()}.isdisjoint(words):
                    return int(process.name)
        raise LookupError(f"no simulators of {self.rig.path} run here")

    def size(self) -> dict[str, int]:
        """Resident bytes and open descriptors of the service."""
        status = Path(f"/proc/{self.child.pid}/status").read_text()
        kilobytes = int(status.partition("VmRSS:")[2].split()[0])
        return {
            "rss_bytes": kilobytes * 1024,
            "descriptors": sum(1 for _ in Path(f"/proc/{self.child.pid}/fd").iterdir()),
        }


@contextlib.contextmanager
def _nothing(_live: Live) -> Iterator[None]:
    yield


@contextlib.contextmanager
def _polls(live: Live) -> Iterator[None]:
    """100 requests a second, where the service keeps up."""
    over = threading.Event()
    threads = [threading.Thread(target=_poll, args=(live, over)) for _ in range(4)]
    for thread in threads:
        thread.start()
    time.sleep(0.5)
    try:
        yield
    finally:
        over.set()
        for thread in threads:
            thread.join()


def _poll(live: Live, over: threading.Event) -> None:
    """25 requests a second."""
    with live.client(live.http.base_url) as http:
        while not over.wait(0.04):
            with contextlib.suppress(httpx.HTTPError):
                http.get("/captures")


@contextlib.contextmanager
def _listeners(live: Live) -> Iterator[None]:
    """200 clients that follow the events, and read what comes."""
    over = threading.Event()
    with _connected(live, 200, live.request("/events")) as links:

        def read() -> None:
            open_ones = list(links)
            while not over.wait(0 if open_ones else 0.1):
                for link in select.select(open_ones, [], [], 0.1)[0]:
                    try:
                        gone = not link.recv(1 << 16)
                    except OSError:  # the service was killed
                        gone = True
                    if gone:
                        open_ones.remove(link)

        thread = threading.Thread(target=read)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()


@contextlib.contextmanager
def _connected(live: Live, number: int, sent: bytes) -> Iterator[list[socket.socket]]:
    url, links = live.http.base_url, list[socket.socket]()
    try:
        for _ in range(number):
            with contextlib.suppress(OSError):
                link = socket.create_connection((url.host, url.port or 80), 5)
                links.append(link)
                link.sendall(sent)
        yield links
    finally:
        for link in links:
            link.close()


@contextlib.contextmanager
def _half_open(live: Live) -> Iterator[None]:
    """1,000 connections that send half a request."""
    with _connected(live, 1000, b"GET /health HTTP/1.1\r\n"):
        yield


@contextlib.contextmanager
def console(live: Live) -> Iterator[None]:
    """A browser that has logged in, follows the events and looks once a second, and Prometheus."""
    over = threading.Event()

    def look() -> None:
        with live.client(live.http.base_url) as http:
            http.post("/login", json={"token": own_token()}).raise_for_status()
            del http.headers["Authorization"]
            while not over.wait(1.0):
                for path in ("/health", "/captures?limit=50", "/devices", "/queue", "/metrics"):
                    http.get(path).raise_for_status()

    thread = threading.Thread(target=look, daemon=True)
    thread.start()
    try:
        with follower(live):
            yield
    finally:
        over.set()
        thread.join()


@contextlib.contextmanager
def follower(live: Live) -> Iterator[None]:
    """A client that follows the events, and reads what comes."""
    link = socket.create_connection((live.http.base_url.host, live.http.base_url.port or 80), 5)
    link.sendall(live.request("/events"))

    def read() -> None:
        with contextlib.suppress(OSError):
            while link.recv(1 << 16):
                pass

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    try:
        yield
    finally:
        link.shutdown(socket.SHUT_RDWR)
        thread.join()
        link.close()


LOADS: dict[str, Callable[[Live], AbstractContextManager[None]]] = {
    "nothing": _nothing,
    "100 requests a second": _polls,
    "200 listeners": _listeners,
    "1,000 half-open connections": _half_open,
}

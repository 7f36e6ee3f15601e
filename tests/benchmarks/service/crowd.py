"""`python -m benchmarks.service.crowd LOAD URL CAPTURE MODEL [TOKEN]`: one load on a service.

Goes on until its standard input is closed, and says then in one line of JSON how often each status
was answered ("ended": the connection was closed without one).
"""

from __future__ import annotations

import json
import os
import select
import socket
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import cycle
from urllib.parse import urlsplit

CONNECTIONS, STREAMS, SLOW, WORKERS = 1000, 256, 515, 32
VIEW = {
    "width": 200,
    "height": 250,
    "K": [[300, 0, 100], [0, 300, 125], [0, 0, 1]],
    "R": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
    "t": [0, 0, 1.0],
}


@dataclass
class Crowd:
    """Somebody with a token (""; none) who asks much of a service."""

    url: str
    capture: str
    model: str
    token: str
    over: threading.Event = field(default_factory=threading.Event)
    responses: Counter[str] = field(default_factory=Counter)

    def connect(self, received: int = 0) -> socket.socket:
        """A connection, which takes no more than about `received` bytes where that is given."""
        link = socket.socket()
        if received:
            link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, received)
        link.settimeout(30)
        parts = urlsplit(self.url)
        link.connect((parts.hostname, parts.port))
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        return link

    def request(self, what: str, body: bytes = b"", length: int | None = None) -> bytes:
        """A request as it goes over the wire; `length` is said to be that of its body."""
        own = f"Authorization: Bearer {self.token}\r\n" if self.token else ""
        length = len(body) if length is None else length
        head = f"{what} HTTP/1.1\r\nHost: {urlsplit(self.url).netloc}\r\n{own}"
        if length:
            head += f"Content-Type: application/json\r\nContent-Length: {length}\r\n"
        return f"{head}\r\n".encode() + body

    def held(self, count: int, sent: bytes, *, received: int = 0, reads: bool = False) -> None:
        """Hold so many connections over which `sent` has gone; opened again where they end."""
        links: dict[int, socket.socket] = {}
        heads: dict[int, bytes] = {}
        while not self.over.is_set():
            for _ in range(min(50, count - len(links))):
                with suppress(OSError):
                    link = self.connect(received)
                    links[link.fileno()] = link
                    link.sendall(sent)
                    link.setblocking(False)
            self._look(links, heads, reads)
        for link in links.values():
            link.close()

    def _look(self, links: dict[int, socket.socket], heads: dict[int, bytes], reads: bool) -> None:
        poll = select.poll()
        for number in links:
            poll.register(number, select.POLLIN if reads or number not in heads else 0)
        for number, _ in poll.poll(200):
            try:
                data = links[number].recv(1 << 16 if reads else 12)
            except BlockingIOError:
                continue
            except OSError:
                data = b""
            if data and number not in heads:
                heads[number] = data[9:12]
                self.responses[data[9:12].decode("latin-1")] += 1
            if not data or (heads.get(number, b"2") > b"300"):
                if number not in heads:
                    self.responses["ended"] += 1
                links.pop(number).close()
                heads.pop(number, None)

    def send_all(
        self, requests: list[bytes], *, workers: int = WORKERS, again: bool = False
    ) -> None:
        """Ask as fast as answers come, over so many connections; a new one each time if `again`."""

        def send_own(own: Iterator[bytes]) -> None:
            link = None
            while not self.over.is_set():
                try:
                    link = link or self.connect()
                    link.sendall(next(own))
                    status, closed = _response(link)
                except OSError:
                    status, closed = "ended", True
                self.responses[status] += 1
                if closed or again:
                    if link is not None:
                        link.close()
                    link = None

        turns = [cycle(requests[k:] + requests[:k]) for k in range(len(requests))]
        threads = [
            threading.Thread(target=send_own, args=(turns[n % len(turns)],), daemon=True)
            for n in range(workers)
        ]
        for thread in threads:
            thread.start()
        self.over.wait()


def _response(link: socket.socket) -> tuple[str, bool]:
    """The status of an answer that is read to its end, and whether the connection ends with it."""
    data = b""
    while b"\r\n\r\n" not in data:
        piece = link.recv(1 << 16)
        if not piece:
            raise ConnectionError
        data += piece
    head, _, body = data.partition(b"\r\n\r\n")
    lines = head.lower().split(b"\r\n")
    length = next((int(x[15:]) for x in lines if x.startswith(b"content-length:")), 0)
    left = length - len(body)
    while left > 0:
        piece = link.recv(min(left, 1 << 20))
        if not piece:
            raise ConnectionError
        left -= len(piece)
    return lines[0][9:12].decode(), b"connection: close" in lines


def _connections(crowd: Crowd) -> None:
    """1,000 connections, that ask once and wait, or, without a token, send half a request."""
    sent = crowd.request("GET /health") if crowd.token else b"GET /health HTTP/1.1\r\nX: "
    crowd.held(CONNECTIONS, sent)


def _streams(crowd: Crowd) -> None:
    """256 event streams that are read."""
    crowd.held(STREAMS, crowd.request("GET /events"), reads=True)


def _readers(crowd: Crowd) -> None:
    """515 archives of a capture that nobody reads."""
    crowd.held(SLOW, crowd.request(f"GET /captures/{crowd.capture}/archive.tar"), received=2048)


def _writers(crowd: Crowd) -> None:
    """64 uploads that send 8 bytes and stop."""
    crowd.held(64, crowd.request("PUT /uploads/x/head.obj", b"v 0 0 0\n", 1_000_000))


def _uploads(crowd: Crowd) -> None:
    """Environments of 32 MB of nothing, and large and deep JSON."""
    zeros = crowd.request(f"PUT /view/models/{crowd.model}/environments/a.exr", bytes(32 << 20))
    wrong = json.dumps({"lights": [1] * 300_000}).encode()[: (1 << 20) - 10]
    deep = b'{"lights":' + 100_000 * b"[" + 100_000 * b"]" + b"}"
    many = b'{"lights":[' + b",".join(250_000 * [b"[]"]) + b"]}"
    bodies = [crowd.request("POST /plans:validate", x) for x in (wrong, deep, many)]
    crowd.send_all([zeros, *bodies], workers=8)


def _renders(crowd: Crowd) -> None:
    """Eight viewers that have light traced."""
    weights = {str(n): [1, 1, 1] for n in range(0, 60, 3)}
    view = json.dumps({"view": VIEW, "weights": weights}).encode()
    path = f"POST /view/models/{crowd.model}/indirect/view"
    crowd.send_all([crowd.request(path, view)], workers=8)


def _requests(crowd: Crowd) -> None:
    """Everything that can be read, over 32 connections, as fast as it is answered."""
    frame = f"/captures/{crowd.capture}/frames/2/cam_0"
    paths = ["/health", "/captures?limit=1000", "/audit?limit=10000", "/rig", f"{frame}.png"]
    paths += [f"{frame}.json", f"{frame}.exr", f"/captures/{crowd.capture}/steps", "/devices"]
    paths += [
        f"/captures/{crowd.capture}/archive.tar",
        "/queue/history",
        "/metrics",
        "/openapi.json",
    ]
    plan = json.dumps({"projectors": []}).encode()
    crowd.send_all(
        [*(crowd.request(f"GET {p}") for p in paths), crowd.request("POST /plans:validate", plan)]
    )


def _arrivals(crowd: Crowd) -> None:
    """The same over a new connection each."""
    crowd.send_all([crowd.request("GET /health"), crowd.request("GET /captures")], again=True)


def _replays(crowd: Crowd) -> None:
    """All events again and again."""
    crowd.held(64, crowd.request("GET /events?after=0"), received=1 << 16)


def _logins(crowd: Crowd) -> None:
    """Logins by tokens that there are not."""
    body = json.dumps({"token": "x" * 43}).encode()
    crowd.send_all([crowd.request("POST /login", body)], again=True)


LOADS: dict[str, Callable[[Crowd], None]] = {
    "connections": _connections,
    "streams": _streams,
    "replays": _replays,
    "slow readers": _readers,
    "slow writers": _writers,
    "uploads": _uploads,
    "renders": _renders,
    "requests": _requests,
    "arrivals": _arrivals,
    "logins": _logins,
}


def main() -> None:
    """Run one load; the processor is the service's where both want it."""
    os.nice(10)
    load, url, capture, model, *token = sys.argv[1:]
    crowd = Crowd(url, capture, model, token[0] if token else "")
    thread = threading.Thread(target=LOADS[load], args=(crowd,), daemon=True)
    thread.start()
    sys.stdin.read()
    crowd.over.set()
    time.sleep(0.3)
    print(json.dumps(crowd.responses), flush=True)
    os._exit(0)


if __name__ == "__main__":
    main()

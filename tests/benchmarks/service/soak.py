"""A service that shoots captures back to back, under load, and is killed now and then.

Leaves `soak.json`: memory and descriptors of the service at each capture's end, what became of each
capture, whether every frame reads back, and how long a blackout took under each load.
"""

from __future__ import annotations

import argparse
import contextlib
import random
import select
import signal
import socket
import statistics
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import httpx

from benchmarks.acquisition.rates import simulated
from benchmarks.command import Benchmark, option
from benchmarks.results import save
from reconstruction import Progress, verify
from stage_service.cli.support.children import Children, own_command
from stage_service.config import RigFile

PLAN = {"lights": [f"light_{i:03d}" for i in range(60)], "stepping": "software"}
WAITING = 3
"""Captures that the queue is kept filled with."""
KILL_EVERY = 7
"""Of so many captures one meets a SIGKILL of the service."""


class Soak:
    """One service on a simulated stage, begun again where it was killed."""

    def __init__(self, rig: RigFile, devices: Path, children: Children, root: Path) -> None:
        self._rig, self._devices, self._children, self.root = rig, devices, children, root
        self.kills = 0
        self.begin()

    def begin(self) -> None:
        """Start the service, or start it again."""
        words = ("serve", "--json", "--no-auth", "--port", "0", "--rig", self._rig.path)
        command = own_command(*words, "--root", self.root, "--devices", self._devices)
        name = f"service-{self.kills}"
        self._child: subprocess.Popen[str] = self._children.start(name, command, answers=True)
        url = self._children.first_line(name, self._child, 300)["url"]
        # A connection each: one that waits for its next request makes room where there are many.
        each = httpx.Limits(max_keepalive_connections=0)
        self.http = httpx.Client(base_url=url, timeout=60, trust_env=False, limits=each)

    def kill(self) -> None:
        """SIGKILL, and a new one."""
        self._child.send_signal(signal.SIGKILL)
        self._child.wait()
        self.http.close()
        self.kills += 1
        self.begin()

    def ask(self, method: str, path: str, body: Any = None) -> Any:
        """The answer's JSON. Raises where it is none of success."""
        return self.http.request(method, path, json=body).raise_for_status().json()

    def size(self) -> dict[str, int]:
        """Resident bytes and open descriptors of the service."""
        status = Path(f"/proc/{self._child.pid}/status").read_text()
        kilobytes = int(status.partition("VmRSS:")[2].split()[0])
        return {
            "rss_bytes": kilobytes * 1024,
            "descriptors": sum(1 for _ in Path(f"/proc/{self._child.pid}/fd").iterdir()),
        }


def run(out: Path, minutes: float, seed: int, progress: Progress) -> dict[str, Any]:
    """Shoot for so long, then measure blackouts; returns what `soak.json` holds."""
    out.mkdir(parents=True, exist_ok=True)
    rng = random.Random(seed)
    result: dict[str, Any] = {"minutes": minutes, "captures": [], "blackouts": []}
    with TemporaryDirectory(dir=out) as scratch, simulated(RIG) as rig:
        devices = rig.path.parent / "devices.toml"
        with Children(Path(scratch) / "logs") as children:
            soak = Soak(rig, devices, children, Path(scratch) / "root")
            begun, seen = time.monotonic(), set[str]()
            while time.monotonic() - begun < 60 * minutes:
                share = (time.monotonic() - begun) / (60 * minutes)
                progress(f"{len(seen)} captures, {soak.kills} kills", 0.8 * share)
                queue = soak.ask("GET", "/queue")
                if queue["held"]:
                    _finish(soak)
                    soak.ask("POST", "/queue:go-on")
                for _ in range(WAITING - len(queue["waiting"])):
                    soak.ask("POST", "/queue", {"plan": PLAN})
                going = soak.ask("GET", "/health")["capture"]
                if going and going not in seen:
                    seen.add(going)
                    result["captures"].append({"id": going, **soak.size()})
                    if len(seen) % KILL_EVERY == 0:
                        time.sleep(rng.uniform(0.0, 1.0))
                        soak.kill()
                time.sleep(0.1)
            _empty(soak)
            result.update(_judge(soak), kills=soak.kills)
            save(out / "soak.json", result)
            for i, (name, load) in enumerate(LOADS.items()):
                progress(f"blackout under {name}", 0.8 + 0.2 * i / len(LOADS))
                result["blackouts"].append({"load": name, **_blackout(soak, load)})
                save(out / "soak.json", result)
    return result


def _finish(soak: Soak) -> None:
    """Let what a kill interrupted shoot what it lacks."""
    for capture in soak.ask("GET", "/captures"):
        if capture["outcome"] == "interrupted":
            soak.ask("POST", f"/captures/{capture['id']}/resume", {})
            _until_done(soak, capture["id"])


def _empty(soak: Soak) -> None:
    """Take out what waits, and let what runs end."""
    soak.ask("POST", "/queue:hold")
    for entry in soak.ask("GET", "/queue")["waiting"]:
        soak.ask("DELETE", f"/queue/{entry['id']}")
    if going := soak.ask("GET", "/health")["capture"]:
        _until_done(soak, going)
    _finish(soak)
    soak.ask("POST", "/queue:go-on")


def _until_done(soak: Soak, capture: str) -> None:
    while soak.ask("GET", f"/captures/{capture}")["state"] != "done":
        time.sleep(0.1)


def _judge(soak: Soak) -> dict[str, Any]:
    """Every capture read again: outcomes, frames, and what is wrong."""
    outcomes: dict[str, int] = {}
    frames, wrong = 0, []
    for capture in soak.ask("GET", "/captures"):
        outcomes[capture["outcome"]] = outcomes.get(capture["outcome"], 0) + 1
        frames += capture["frames_written"]
        wrong += [f"{capture['id']}: {problem}" for problem in verify(capture["path"])]
    return {"outcomes": outcomes, "frames": frames, "wrong": wrong, "at_the_end": soak.size()}


def _blackout(soak: Soak, load: Any) -> dict[str, Any]:
    """Seconds that blackouts took while a capture ran under `load`; the slowest and the median."""
    seconds, safe = [], True
    for _ in range(3):
        with load(soak):
            capture = soak.ask("POST", "/captures", {"plan": PLAN})["id"]
            time.sleep(0.3)
            begin = time.monotonic()
            safe &= soak.ask("POST", "/devices/blackout")["safe"]
            seconds.append(time.monotonic() - begin)
        _until_done(soak, capture)
    return {"median_s": statistics.median(seconds), "slowest_s": max(seconds), "dark": safe}


@contextlib.contextmanager
def _nothing(_soak: Soak) -> Iterator[None]:
    yield


@contextlib.contextmanager
def _polls(soak: Soak) -> Iterator[None]:
    """100 requests a second, where the service keeps up."""
    over = threading.Event()
    threads = [threading.Thread(target=_poll, args=(soak, over)) for _ in range(4)]
    for thread in threads:
        thread.start()
    time.sleep(0.5)
    try:
        yield
    finally:
        over.set()
        for thread in threads:
            thread.join()


def _poll(soak: Soak, over: threading.Event) -> None:
    """25 requests a second."""
    with httpx.Client(base_url=soak.http.base_url, timeout=60, trust_env=False) as http:
        while not over.wait(0.04):
            with contextlib.suppress(httpx.HTTPError):
                http.get("/captures")


@contextlib.contextmanager
def _listeners(soak: Soak) -> Iterator[None]:
    """200 clients that follow the events, and read what comes."""
    over = threading.Event()
    with _connected(soak, 200, b"GET /events HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n") as links:

        def read() -> None:
            while not over.is_set():
                for link in select.select(links, [], [], 0.1)[0]:
                    link.recv(1 << 16)

        thread = threading.Thread(target=read)
        thread.start()
        try:
            yield
        finally:
            over.set()
            thread.join()


@contextlib.contextmanager
def _connected(soak: Soak, number: int, sent: bytes) -> Iterator[list[socket.socket]]:
    url, links = soak.http.base_url, list[socket.socket]()
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
def _half_open(soak: Soak) -> Iterator[None]:
    """1,000 connections that send half a request."""
    with _connected(soak, 1000, b"GET /health HTTP/1.1\r\n"):
        yield


LOADS = {
    "nothing": _nothing,
    "100 requests a second": _polls,
    "200 listeners": _listeners,
    "1,000 half-open connections": _half_open,
}

RIG = """
name = "soak"
[dome]
lights = 60
radius = 1.2
intensity = [8.0, 8.0, 8.0]
[[cameras]]
name = "cam_0"
position = [-0.3, -0.9, 0.1]
target = [0.0, 0.0, 0.0]
fov_deg = 22.0
width = 32
height = 32
[[cameras]]
name = "cam_1"
position = [0.3, -0.9, 0.1]
target = [0.0, 0.0, 0.0]
fov_deg = 22.0
width = 32
height = 32
[devices]
watchdog_s = 10.0
[devices.lights]
port = 15020
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
[capture.exposure]
dark = 0.005
all_on = 0.005
olat = 0.005
"""


def _bench(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    return run(args.out, 0.2 if args.quick else args.minutes, args.seed, progress)


BENCHMARK = Benchmark(_bench, (option("--minutes", "how long to shoot", type=float, default=60.0),))

"""What a caller can take from others: load x caller x fault.

For each load and each caller captures are shot in pairs, with it and without it, while a page of an
operator follows the events and looks at the service; then blackouts are requested while a capture
is shot, and while a fault strikes. Leaves `callers.json` and, as a table, `callers.md`.
"""

from __future__ import annotations

import argparse
import json
import os
import select
import signal
import socket
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Self

import httpx

from appearance import Exposure, HairAppearance
from appearance.observations import HeldOut
from appearance.sun_fit.fitted_appearance import FittedAppearance
from benchmarks.command import Benchmark, option
from benchmarks.results import markdown, save
from benchmarks.service.crowd import LOADS
from benchmarks.service.live import DEVICES, FLAT, HURRY_S, Live
from reconstruction import Model, Progress
from simulators.subject.subject import make_subject
from stage_service.cli.support.children import Children
from stage_service.config import load_rig_file
from stage_service.records.tokens import Scope, Tokens

CALLERS: dict[str, tuple[Scope, ...]] = {
    "none": (),
    "read": ("read",),
    "jobs": ("read", "jobs"),
    "steer": ("read", "steer"),
}
"""Who brings the load: the scopes of its token."""
MODEL = "demo"
PLAN = {"projectors": [], "stepping": "software"}
SETTLED_S = 1.5
"""From a load's first request on, before a capture is begun: what it holds open is open then."""
BLACKOUTS = 3
"""While captures are shot, and as many while nothing is."""
ABOUT_S = 0.5
GOALS = {"blackout_s": 0.5, "slowdown": 1.05}
HEAD = (
    "load",
    "caller",
    "fault",
    "capture, with : without (standard error)",
    "blackout, s: median, worst",
    "said",
    "page: lost streams, longest silence, failed looks",
    "operator's requests sent again",
    "answers",
)


class Page:
    """What an operator's page does: follows the events, and looks once in a while."""

    def __init__(self, live: Live) -> None:
        self._live = live
        self._over = threading.Event()
        self.lost = self.failed = self.looks = 0
        self.silence_s = 0.0
        self._threads = [threading.Thread(target=work) for work in (self._follow, self._look)]

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        for thread in self._threads:
            thread.join()

    def _follow(self) -> None:
        url = self._live.http.base_url
        while not self._over.is_set():
            with socket.create_connection((url.host, url.port or 80), 30) as link:
                link.sendall(self._live.request("/events"))
                self._read(link)
            self.lost += not self._over.is_set()

    def _read(self, link: socket.socket) -> None:
        while not self._over.is_set():
            if select.select([link], [], [], 0.2)[0]:
                data = link.recv(1 << 16)
                if not data or (data.startswith(b"HTTP/1.1 ") and b" 200 " not in data[:14]):
                    return

    def _look(self) -> None:
        with self._live.client(self._live.http.base_url, limits=ONE_EACH) as http:
            while not self._over.wait(ABOUT_S):
                for path in ("/health", "/captures?limit=20", "/"):
                    began = time.monotonic()
                    try:
                        self.failed += http.get(path, timeout=10).status_code != httpx.codes.OK
                    except httpx.HTTPError:
                        self.failed += 1
                    self.looks += 1
                    self.silence_s = max(self.silence_s, time.monotonic() - began)


ONE_EACH = httpx.Limits(max_keepalive_connections=0)


class _Load:
    """A crowd, in a process of its own, for as long as the block; `answers` it got."""

    def __init__(self, load: str, live: Live, capture: str, token: str) -> None:
        module = [sys.executable, "-m", "benchmarks.service.crowd"]
        self._command = [
            *module,
            load,
            str(live.http.base_url),
            capture,
            MODEL,
            *filter(None, [token]),
        ]
        self.responses: dict[str, int] = {}

    def __enter__(self) -> Self:
        pipe = subprocess.PIPE
        self._child = subprocess.Popen(self._command, stdin=pipe, stdout=pipe, text=True)
        time.sleep(SETTLED_S)
        return self

    def __exit__(self, *_: object) -> None:
        out, _err = self._child.communicate(timeout=HURRY_S)
        for status, count in json.loads(out).items():
            self.responses[status] = self.responses.get(status, 0) + count


def _capture(live: Live) -> float:
    """Seconds of a capture that nobody asks about until its end."""
    capture = live.call("POST", "/captures", {"plan": PLAN})["id"]
    while (status := live.call("GET", f"/captures/{capture}"))["state"] != "done":
        time.sleep(0.25)
    assert status["outcome"] == "completed", status
    return float(status["seconds"])


def _blackout(
    live: Live, fault: Callable[[Live], AbstractContextManager[None]]
) -> tuple[float, str]:
    """Seconds until a blackout is answered over a new connection, and its answer."""
    with fault(live), live.client(live.http.base_url, limits=ONE_EACH) as http:
        began = time.monotonic()
        try:
            response = http.post("/devices/blackout", timeout=30)
            said = response.json()["state"] if response.is_success else str(response.status_code)
        except httpx.HTTPError as error:
            said = type(error).__name__
        return time.monotonic() - began, said


@contextmanager
def _none(_live: Live) -> Iterator[None]:
    yield


@contextmanager
def _hung(live: Live) -> Iterator[None]:
    """Every device stands still until the blackout was answered: "unknown, unsafe", in 1 s."""
    devices = live.stage_pid()
    os.kill(devices, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(devices, signal.SIGCONT)


FAULTS: dict[str, Callable[[Live], AbstractContextManager[None]]] = {
    "none": _none,
    "devices hang": _hung,
}


def _cell(live: Live, load: str, capture: str, token: str, pairs: int) -> dict[str, Any]:
    """One load by one caller."""
    with_it: list[float] = []
    without: list[float] = []
    blackouts: dict[str, list[tuple[float, str]]] = {name: [] for name in FAULTS}
    resent = live.resent
    with Page(live) as page:
        crowd = _Load(load, live, capture, token)
        for pair in range(pairs):
            for under in (True, False) if pair % 2 else (False, True):
                with crowd if under else nullcontext():
                    (with_it if under else without).append(_capture(live))
        with crowd:
            for number in range(BLACKOUTS):
                for name, fault in FAULTS.items():
                    live.call("POST", "/captures", {"plan": PLAN})
                    time.sleep(0.5 + 0.2 * number)
                    blackouts[name].append(_blackout(live, fault))
                    _settle(live)
                blackouts["none"].append(_blackout(live, _none))
    ratios = [a / b for a, b in zip(with_it, without, strict=True)]
    return {
        "seconds_with": with_it,
        "seconds_without": without,
        "ratios": ratios,
        "slowdown": statistics.median(ratios) if ratios else None,
        "standard_error": _standard_error(ratios),
        "blackouts": blackouts,
        "page": {
            "lost": page.lost,
            "slowest_look_s": page.silence_s,
            "failed": page.failed,
            "looks": page.looks,
        },
        "resent": live.resent - resent,
        "answers": crowd.responses,
    }


def _standard_error(found: Sequence[float]) -> float | None:
    return statistics.stdev(found) / len(found) ** 0.5 if len(found) > 1 else None


def _settle(live: Live) -> None:
    """Wait until nothing runs, and all is dark."""
    deadline = time.monotonic() + HURRY_S
    while True:
        dark = live.call("POST", "/devices/blackout")["state"] == "dark"
        if dark and live.call("GET", "/health")["capture"] is None:
            return
        assert time.monotonic() < deadline, "it never came to rest"
        time.sleep(0.1)


def run(
    out: Path, loads: Sequence[str], callers: Sequence[str], pairs: int, progress: Progress
) -> dict[str, Any]:
    """Every load by every caller; returns what `callers.json` holds."""
    out.mkdir(parents=True, exist_ok=True)
    cells: list[dict[str, Any]] = []
    result = {"goals": GOALS, "cells": cells, "load_average": os.getloadavg()[0]}
    with TemporaryDirectory(dir=out) as scratch:
        folder = Path(scratch)
        (folder / "rig.toml").write_text(RIG)
        model(folder / "root" / "models" / MODEL)
        with Children(folder / "logs") as children:
            module = [sys.executable, "-m", FLAT]
            children.ready("simulators", [*module, str(folder / "rig.toml"), str(folder)], 120)
            live = Live(
                load_rig_file(folder / "rig.toml", folder / "devices.toml"),
                children,
                folder / "root",
            )
            known = Tokens(folder / "root" / "tokens.json")
            tokens = {
                name: known.make(name, CALLERS[name]) if CALLERS[name] else "" for name in callers
            }
            capture = live.call("POST", "/captures", {"plan": PLAN})["id"]
            live.until_done(capture)
            for number, load in enumerate(loads):
                for name in callers:
                    progress(f"{load}, {name}", number / len(loads))
                    cell = _cell(live, load, capture, tokens[name], pairs)
                    cells.append({"load": load, "caller": name, **cell})
                    save(out / "callers.json", result)
                    (out / "callers.md").write_text(markdown(HEAD, map(_row, cells)))
            live.end()
    return result


def model(path: Path) -> None:
    """A small model with a material, to trace light in."""
    subject, grey = make_subject("wavy", 1, strands=2000), (0.2, 0.2, 0.2)
    made = Model(path).create()
    made.write_strands(subject.strands)
    assert subject.head is not None
    made.write_head(subject.head)
    hair = HairAppearance((0.1, 0.3, 0.9), 0.3, 0.25)
    FittedAppearance(hair, grey, grey, Exposure(1.0), 0.1, 0.1, 0.1, HeldOut()).save(made)


def _row(cell: dict[str, Any]) -> tuple[object, ...]:
    found = [(name, *x) for name, all_ in cell["blackouts"].items() for x in all_]
    seconds = {name: [s for n, s, _ in found if n == name] for name in FAULTS}
    shown = "; ".join(
        f"{name}: {statistics.median(s):.2f}, {max(s):.2f}" for name, s in seconds.items() if s
    )
    error, page = cell["standard_error"], cell["page"]
    slower = "" if cell["slowdown"] is None else f"{cell['slowdown']:.3f}"
    return (
        cell["load"],
        cell["caller"],
        ", ".join(FAULTS),
        slower + ("" if error is None else f" ({error:.3f})"),
        shown,
        ", ".join(sorted({said for _, _, said in found})),
        f"{page['lost']}, {page['slowest_look_s']:.2f} s, {page['failed']} of {page['looks']}",
        cell["resent"],
        ", ".join(f"{k}: {v}" for k, v in sorted(cell["answers"].items())),
    )


RIG = (
    """
name = "callers"
[dome]
lights = 331
radius = 1.2
intensity = [8.0, 8.0, 8.0]
"""
    + "".join(
        f"""
[[cameras]]
name = "cam_{i}"
position = [{x}, -0.9, 0.1]
target = [0.0, 0.0, 0.0]
fov_deg = 22.0
width = 64
height = 64
"""
        for i, x in enumerate((-0.3, 0.0, 0.3))
    )
    + """
[[projectors]]
name = "left"
position = [0.4, -0.9, 0.5]
target = [0.0, 0.0, 0.0]
fov_deg = 20.0
width = 16
height = 16
[devices]
watchdog_s = 10.0
"""
    + DEVICES
    + """[capture.exposure]
dark = 0.02
all_on = 0.02
olat = 0.02
scanline = 0.02
tracking = 0.02
"""
)


def _bench(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    pairs = 1 if args.quick else args.pairs
    return run(args.out, args.loads, args.callers, pairs, progress)


OPTIONS = (
    option("--loads", "which", nargs="+", choices=tuple(LOADS), default=list(LOADS)),
    option(
        "--callers",
        "whose token brings them",
        nargs="+",
        choices=tuple(CALLERS),
        default=list(CALLERS),
    ),
    option("--pairs", "captures with and without each", type=int, default=6),
)
BENCHMARK = Benchmark(_bench, OPTIONS)

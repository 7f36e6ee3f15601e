"""What an open console costs: captures beside clients that follow the events, and beside pages.

Leaves `console.json`: of rounds that take each kind of watcher in turns, a capture's seconds and
the service's processor time by those of a capture that nobody watches; the processor time that
three pages take by themselves; and what each watcher costs a service that does nothing.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.acquisition.rates import simulated
from benchmarks.command import Benchmark, LeftOut, option
from benchmarks.results import save
from benchmarks.service.live import Live, follower
from benchmarks.service.soak import RIG
from reconstruction import Progress
from stage_service.cli.support.children import Children
from stage_service.records.tokens import own_token

WATCHERS = 3
SETTLED_S = 3.0
PLAN = {"projectors": [], "stepping": "software", "brackets": [1, 1.5, 2, 2.5]}
TICK_S = 1 / os.sysconf("SC_CLK_TCK")
Watch = Callable[[Live], AbstractContextManager[None]]


def run(
    out: Path, rounds: int, idle_s: float, rate_hz: float, progress: Progress
) -> dict[str, Any]:
    """Shoot `rounds` captures beside each kind of watchers, after one for the stage's pictures."""
    out.mkdir(parents=True, exist_ok=True)
    shot: dict[str, list[dict[str, float]]] = {name: [] for name in ("nobody", "streams", "pages")}
    idle: dict[str, float] = {}
    plan = {**PLAN, "rate_hz": rate_hz}
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory(dir=out)))
        pages = stack.enter_context(_browser())
        watches: dict[str, Watch] = {"nobody": _nobody, "streams": _streams, "pages": pages}
        rig = stack.enter_context(simulated(RIG))
        live = Live(rig, stack.enter_context(Children(folder / "logs")), folder / "root")
        live.until_done(live.ask("POST", "/captures", {"plan": plan})["id"])
        for number in range(rounds):
            names = list(shot)[number % 3 :] + list(shot)[: number % 3]
            for name in names:
                progress(f"round {number}: {name}", number / rounds)
                with watches[name](live):
                    time.sleep(SETTLED_S)
                    if number == 0:
                        idle[name] = _idle(live, idle_s)
                    shot[name].append(_shoot(live, plan))
                save(out / "console.json", _result(shot, idle))
        live.end()
    return _result(shot, idle)


def _result(shot: dict[str, list[dict[str, float]]], idle: dict[str, float]) -> dict[str, Any]:
    alone = shot["nobody"]
    ratios: dict[str, Any] = {}
    for name in ("streams", "pages"):
        pairs = list(zip(shot[name], alone, strict=False))
        for what in ("seconds", "service_cpu_s") if pairs else ():
            found = [a[what] / b[what] for a, b in pairs]
            ratios[f"{name}_{what}"] = {"median": statistics.median(found), "all": found}
    each = {
        name: (share - idle["nobody"]) / WATCHERS
        for name, share in idle.items()
        if name != "nobody" and "nobody" in idle
    }
    return {
        "watchers": WATCHERS,
        "captures": shot,
        "ratios": ratios,
        "idle_service_cpu_share": idle,
        "idle_service_cpu_share_each": each,
        "goals": {"pages_seconds": 1.02, "idle_each": 0.01},
        "cores": os.cpu_count(),
        "load_average": os.getloadavg()[0],
    }


def _shoot(live: Live, plan: dict[str, Any]) -> dict[str, float]:
    service, browser = _cpu_s(live.child.pid), _browser_cpu_s()
    capture = live.ask("POST", "/captures", {"plan": plan})["id"]
    while live.ask("GET", "/health")["capture"] is not None:
        time.sleep(0.5)
    status = live.ask("GET", f"/captures/{capture}")
    if status["outcome"] != "completed":
        raise LeftOut(f"a capture came to {status['outcome']}: {status['error']}")
    return {
        "seconds": status["seconds"],
        "service_cpu_s": _cpu_s(live.child.pid) - service,
        "browser_cpu_s": _browser_cpu_s() - browser,
    }


def _idle(live: Live, seconds: float) -> float:
    """The share of a core that the service takes while nothing happens."""
    before, began = _cpu_s(live.child.pid), time.monotonic()
    time.sleep(seconds)
    return (_cpu_s(live.child.pid) - before) / (time.monotonic() - began)


def _nobody(_live: Live) -> AbstractContextManager[None]:
    return nullcontext()


@contextlib.contextmanager
def _streams(live: Live) -> Iterator[None]:
    """Clients that follow the events and do nothing with them."""
    with ExitStack() as stack:
        for _ in range(WATCHERS):
            stack.enter_context(follower(live))
        yield


@contextlib.contextmanager
def _browser() -> Iterator[Watch]:
    """A browser, and what opens pages of the console in it. Raises `LeftOut` without one."""
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    try:
        from playwright.sync_api import sync_playwright
    except ImportError as error:
        raise LeftOut("Playwright is not installed: pip install 'hairstage[test]'") from error
    if chromium is None:
        raise LeftOut("there is no Chromium here")

    @contextlib.contextmanager
    def pages(live: Live) -> Iterator[None]:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        try:
            context = browser.new_context(base_url=str(live.http.base_url))
            context.request.post("/login", data={"token": own_token()})
            for _ in range(WATCHERS):
                page = context.new_page()
                page.goto("/#now")
                page.wait_for_selector("h1.big")
            yield
        finally:
            browser.close()

    with sync_playwright() as playwright:
        yield pages


def _cpu_s(pid: int) -> float:
    """User and system seconds of a process and of its children that have ended."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, fields[11:15])) * TICK_S


def _browser_cpu_s() -> float:
    """That of all processes that this one has begun which are a browser's."""
    found, parents = 0.0, {os.getpid()}
    known: dict[int, tuple[int, str]] = {}
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            text = (process / "stat").read_text()
            known[int(process.name)] = (int(text.rpartition(")")[2].split()[1]), text)
    while more := {pid for pid, (parent, _) in known.items() if parent in parents} - parents:
        parents |= more
    for pid in parents - {os.getpid()}:
        if "chrom" in known[pid][1].partition("(")[2].partition(")")[0]:
            with contextlib.suppress(OSError):
                found += _cpu_s(pid)
    return found


def _bench(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    rounds, idle_s = (1, 2.0) if args.quick else (args.rounds, 45.0)
    return run(args.out, rounds, idle_s, args.rate, progress)


OPTIONS = (
    option("--rounds", "captures of each kind", type=int, default=6),
    option("--rate", "most steps a second", type=float, default=30.0),
)
BENCHMARK = Benchmark(_bench, OPTIONS)

"""What an open console costs: captures beside clients that follow the events, and beside pages.

Leaves `console.json`: of rounds that take each kind of watcher in turns, a capture's seconds and
the service's processor time by those of a capture that nobody watches; those of a service with
tokens, an open console and Prometheus by those of one without; the processor time that three pages
take by themselves; and what each watcher costs a service that does nothing.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.acquisition.rates import simulated
from benchmarks.browser import browser_cpu_s, chromium, cpu_s
from benchmarks.command import Benchmark, LeftOut, option
from benchmarks.results import save
from benchmarks.service.live import Live, console, follower
from benchmarks.service.soak import RIG
from reconstruction import Progress
from stage_service.cli.support.children import Children
from stage_service.records.tokens import own_token

WATCHERS = 3
BARE = "no_auth"
BESIDE = {"streams": "nobody", "pages": "nobody", "console": BARE, "nobody": BARE}
"""What each kind of capture is measured by."""
KINDS = (*BESIDE, BARE)
SETTLED_S = 3.0
PLAN = {"projectors": [], "stepping": "software", "brackets": [1, 1.5, 2, 2.5]}
Watch = Callable[[Live], AbstractContextManager[None]]


def run(
    out: Path, kinds: Sequence[str], rounds: int, idle_s: float, rate_hz: float, progress: Progress
) -> dict[str, Any]:
    """Shoot `rounds` captures of each of the `kinds`, after one for each stage's pictures."""
    out.mkdir(parents=True, exist_ok=True)
    shot: dict[str, list[dict[str, float]]] = {name: [] for name in kinds}
    idle: dict[str, float] = {}
    plan = {**PLAN, "rate_hz": rate_hz}
    with ExitStack() as stack:
        folder = Path(stack.enter_context(TemporaryDirectory(dir=out)))
        watches: dict[str, Watch] = {
            "nobody": _nobody,
            "streams": _streams,
            "console": console,
            BARE: _nobody,
        }
        if "pages" in kinds:
            watches["pages"] = stack.enter_context(_browser())
        children = stack.enter_context(Children(folder / "logs"))

        def begin(root: str, *more: str) -> Live:
            """A stage of its own, with its service."""
            live = Live(stack.enter_context(simulated(RIG)), children, folder / root, more=more)
            live.until_done(live.ask("POST", "/captures", {"plan": plan})["id"])
            return live

        asks = begin("root")
        bare = begin("bare", "--no-auth") if BARE in kinds else asks
        for number in range(rounds):
            turn = number % len(kinds)
            for name in [*kinds[turn:], *kinds[:turn]]:
                progress(f"round {number}: {name}", number / rounds)
                live = bare if name == BARE else asks
                with watches[name](live):
                    time.sleep(SETTLED_S)
                    if number == 0:
                        idle[name] = _idle(live, idle_s)
                    shot[name].append(_shoot(live, plan))
                save(out / "console.json", _result(shot, idle))
        for live in {asks, bare}:
            live.end()
    return _result(shot, idle)


def _result(shot: dict[str, list[dict[str, float]]], idle: dict[str, float]) -> dict[str, Any]:
    ratios: dict[str, Any] = {}
    for name, other in BESIDE.items():
        pairs = list(zip(shot.get(name, []), shot.get(other, []), strict=False))
        for what in ("seconds", "service_cpu_s") if pairs else ():
            found = [a[what] / b[what] for a, b in pairs]
            ratios[f"{name}_by_{other}_{what}"] = {
                "median": statistics.median(found),
                "standard_error": _standard_error(found),
                "all": found,
            }
    each = {
        name: (idle[name] - idle["nobody"]) / WATCHERS
        for name in ("streams", "pages")
        if name in idle and "nobody" in idle
    }
    return {
        "watchers": WATCHERS,
        "captures": shot,
        "ratios": ratios,
        "idle_service_cpu_share": idle,
        "idle_service_cpu_share_each": each,
        "goals": {"pages_by_nobody": 1.02, "console_by_no_auth": 1.02, "idle_each": 0.01},
        "cores": os.cpu_count(),
        "load_average": os.getloadavg()[0],
    }


def _standard_error(found: Sequence[float]) -> float | None:
    """Of the mean; unknown of a single one."""
    return statistics.stdev(found) / len(found) ** 0.5 if len(found) > 1 else None


def _shoot(live: Live, plan: dict[str, Any]) -> dict[str, float]:
    service, browser = cpu_s(live.child.pid), browser_cpu_s()
    capture = live.ask("POST", "/captures", {"plan": plan})["id"]
    while live.ask("GET", "/health")["capture"] is not None:
        time.sleep(0.5)
    status = live.ask("GET", f"/captures/{capture}")
    if status["outcome"] != "completed":
        raise LeftOut(f"a capture came to {status['outcome']}: {status['error']}")
    return {
        "seconds": status["seconds"],
        "service_cpu_s": cpu_s(live.child.pid) - service,
        "browser_cpu_s": browser_cpu_s() - browser,
    }


def _idle(live: Live, seconds: float) -> float:
    """The share of a core that the service takes while nothing happens."""
    before, began = cpu_s(live.child.pid), time.monotonic()
    time.sleep(seconds)
    return (cpu_s(live.child.pid) - before) / (time.monotonic() - began)


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
    """What opens pages of the console in a browser. Raises `LeftOut` without one."""
    with chromium() as launch:

        @contextlib.contextmanager
        def pages(live: Live) -> Iterator[None]:
            browser = launch()
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

        yield pages


def _bench(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    rounds, idle_s = (1, 2.0) if args.quick else (args.rounds, 45.0)
    return run(args.out, args.kinds, rounds, idle_s, args.rate, progress)


OPTIONS = (
    option("--kinds", "which captures", nargs="+", choices=KINDS, default=list(KINDS)),
    option("--rounds", "captures of each kind", type=int, default=6),
    option("--rate", "most steps a second", type=float, default=30.0),
)
BENCHMARK = Benchmark(_bench, OPTIONS)

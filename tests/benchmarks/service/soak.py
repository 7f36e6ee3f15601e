"""A service that shoots captures back to back, a job for each, and SIGKILLs; then load x fault.

Leaves `soak.json`: memory and descriptors of the service at each capture's end, what became of each
capture and job, whether every frame reads back; of each fault under each load, how long a blackout
took, the frames that were lost, and whether the capture was finished, as a table in `loads.md` too;
and what an open console costs a capture.
"""

from __future__ import annotations

import argparse
import itertools
import random
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Self

import numpy as np

from benchmarks.acquisition.rates import simulated
from benchmarks.command import Benchmark, option
from benchmarks.results import markdown, save
from benchmarks.service.faults import HEAD, Cell, cells
from benchmarks.service.live import DEVICES, Live, console
from reconstruction import Progress, verify
from stage_service.cli.support.children import Children
from stage_service.config import RigFile

PLAN = {
    "lights": [f"light_{i:03d}" for i in range(60)],
    "projectors": [],
    "stepping": "software",
}
WAITING = 3
"""Captures that the queue is kept filled with."""
PAIRS = 10
"""Captures with a console beside ones without."""
KILL_EVERY = 60
"""Of so many captures one meets a SIGKILL: a service lives for minutes, and a leak shows."""
KILL_WORKER_EVERY = 20
"""Of so many captures one meets a worker's SIGKILL."""
JOB_WORKER = Path(__file__).parents[2] / "stage_service/jobs/job_worker.py"
"""Its steps take 50 ms and tell who does them: what is tried is the queue."""


def run(
    out: Path, minutes: float, seed: int, progress: Progress, *, quick: bool, table: bool
) -> dict[str, Any]:
    """Shoot for so long, then fill the table; returns what `soak.json` holds."""
    out.mkdir(parents=True, exist_ok=True)
    result: dict[str, Any] = {"minutes": minutes, "captures": [], "cells": []}
    with TemporaryDirectory(dir=out) as scratch, simulated(RIG) as rig:
        folder = Path(scratch)
        with Children(folder / "logs") as children:
            if minutes > 0:
                live = Live(rig, children, folder / "root")
                with _Worker(live.root) as worker:
                    _shoot(live, worker, minutes, random.Random(seed), result, progress)
                live.end()
                save(out / "soak.json", result)
            result["console"] = _monitored(rig, children, folder, 1 if quick else PAIRS, progress)
            save(out / "soak.json", result)
            found: list[Cell] = []
            for cell in cells(rig, children, folder, progress, quick=quick) if table else ():
                found.append(cell)
                result["cells"] = [c.__dict__ for c in found]
                save(out / "soak.json", result)
                (out / "loads.md").write_text(markdown(HEAD, [c.row() for c in found]))
    return result


def _monitored(
    rig: RigFile, children: Children, folder: Path, pairs: int, progress: Progress
) -> dict[str, Any]:
    """Seconds of captures with an open console, and metrics asked for, over those of captures that
    nobody looks at; one right after the other, which is first taken in turns."""
    live = Live(rig, children, folder / "watched")
    seconds: dict[bool, list[float]] = {True: [], False: []}
    for pair in range(-1, pairs):  # before the first, the stage makes its pictures
        progress(f"console, pair {pair}", 0.5)
        for monitored in (True, False) if pair % 2 else (False, True):
            with console(live) if monitored else nullcontext():
                time.sleep(1.0)
                capture = live.call("POST", "/captures", {"plan": PLAN})["id"]
                took = _seconds(live, capture)
            if pair >= 0:
                seconds[monitored].append(took)
    live.end()
    ratios = [a / b for a, b in zip(seconds[True], seconds[False], strict=True)]
    return {
        "watched_s": seconds[True],
        "alone_s": seconds[False],
        "ratio_median": statistics.median(ratios),
        "ratios": ratios,
        "goal": 1.02,
    }


def _seconds(live: Live, capture: str) -> float:
    """Seconds of a capture that is hardly asked about."""
    while live.call("GET", f"/captures/{capture}")["state"] != "done":
        time.sleep(1.0)
    return float(live.call("GET", f"/captures/{capture}")["seconds"])


class _Worker:
    """One worker of `root`, begun again where it was killed."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self.kills = 0
        self._child = self._begin()

    def _begin(self) -> subprocess.Popen[bytes]:
        command = [sys.executable, str(JOB_WORKER), str(self._root), "light"]
        return subprocess.Popen(command, stdout=subprocess.DEVNULL)

    def kill(self) -> None:
        """SIGKILL, and begin the next."""
        self._child.kill()
        self._child.wait()
        self.kills += 1
        self._child = self._begin()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._child.kill()
        self._child.wait()


def _shoot(
    live: Live,
    worker: _Worker,
    minutes: float,
    rng: random.Random,
    result: dict[str, Any],
    progress: Progress,
) -> None:
    begun, known_ids, before = time.monotonic(), set[str](), None
    while time.monotonic() - begun < 60 * minutes:
        elapsed_share = (time.monotonic() - begun) / (60 * minutes)
        summary = f"{live.kills} kills of the service, {worker.kills} of workers"
        progress(f"{len(known_ids)} captures, {summary}", 0.5 * elapsed_share)
        queue = live.call("GET", "/queue")
        if queue["held"]:
            _finish(live)
            _go_on(live)
        for _ in range(WAITING - len(queue["waiting"])):
            live.call("POST", "/queue", {"plan": PLAN})
        going = live.call("GET", "/health")["capture"]
        if going and going not in known_ids:
            known_ids.add(going)
            result["captures"].append({"id": going, "life": live.kills, **live.size()})
            if before and live.call("GET", f"/captures/{before}")["outcome"] == "completed":
                job = {"capture": before, "pipeline": {"name": "reconstruct"}}
                live.call("POST", "/jobs", job)
            before = going
            if len(known_ids) % KILL_WORKER_EVERY == 0:
                time.sleep(rng.uniform(0.0, 1.0))
                worker.kill()
            if len(known_ids) % KILL_EVERY == 0:
                time.sleep(rng.uniform(0.0, 1.0))
                live.kill()
                live.begin()
        time.sleep(0.1)
    _empty(live)
    kills = {"kills": live.kills, "worker_kills": worker.kills}
    result.update(_judge(live), jobs=_jobs(live), growth=_growth(result["captures"]), **kills)


def _growth(captures: list[dict[str, Any]]) -> dict[str, float]:
    """Bytes and descriptors that the service gains a capture, over the second halves of its longer
    lives: the medians of straight lines' slopes. What is loaded once comes in the first halves."""
    slopes: dict[str, list[float]] = {"rss_bytes": [], "descriptors": []}
    for _, life in itertools.groupby(captures, key=lambda c: c["life"]):
        rows = list(life)
        rows = rows[len(rows) // 2 :]
        if len(rows) >= KILL_EVERY // 3:
            for name, found in slopes.items():
                found.append(float(np.polyfit(range(len(rows)), [r[name] for r in rows], 1)[0]))
    return {name: statistics.median(found) for name, found in slopes.items() if found}


def _jobs(live: Live) -> dict[str, int]:
    """How many jobs came to which outcome, once all are done, and how many steps were done twice:
    each has two, and one is done again where its worker was killed in it."""
    outcomes: dict[str, int] = {}
    again = 0
    for job in _paged(live, "jobs"):
        while job["state"] != "done":
            time.sleep(0.5)
            job = live.call("GET", f"/jobs/{job['id']}")
        outcomes[job["outcome"]] = outcomes.get(job["outcome"], 0) + 1
        lines = (Path(job["model"]) / "log.txt").read_text().splitlines()
        again += sum(line.startswith("begins") for line in lines) - 2
    return {**outcomes, "steps_again": again}


def _paged(live: Live, kind: str) -> Iterator[dict[str, Any]]:
    """All captures or jobs."""
    page = 1000
    for offset in itertools.count(0, page):
        found = live.call("GET", f"/{kind}?limit={page}&offset={offset}")
        yield from found
        if len(found) < page:
            break


def _finish(live: Live) -> None:
    """Let what a kill interrupted shoot what it lacks."""
    for capture in live.call("GET", "/captures"):
        if capture["outcome"] == "interrupted":
            live.call("POST", f"/captures/{capture['id']}/resume", {})
            live.until_done(capture["id"])


def _empty(live: Live) -> None:
    """Take out what waits, and let what runs end."""
    live.call("POST", "/queue:hold")
    for entry in live.call("GET", "/queue")["waiting"]:
        live.call("DELETE", f"/queue/{entry['id']}")
    if going := live.call("GET", "/health")["capture"]:
        live.until_done(going)
    _finish(live)
    _go_on(live)


def _go_on(live: Live) -> None:
    """Say that the queue may go on, whatever it was held for."""
    if (hold := live.call("GET", "/queue")["hold"]) is not None:
        live.call("POST", "/queue:go-on", {"hold": hold["id"]})


def _judge(live: Live) -> dict[str, Any]:
    """Every capture read again: outcomes, frames, and what is wrong."""
    outcomes: dict[str, int] = {}
    frames, wrong = 0, []
    for capture in _paged(live, "captures"):
        outcomes[capture["outcome"]] = outcomes.get(capture["outcome"], 0) + 1
        frames += capture["frames_written"]
        wrong += [f"{capture['id']}: {problem}" for problem in verify(capture["path"])]
    return {"outcomes": outcomes, "frames": frames, "wrong": wrong, "at_the_end": live.size()}


RIG = (
    """
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
[[projectors]]
name = "left"
position = [0.4, -0.9, 0.5]
target = [0.0, 0.0, 0.0]
fov_deg = 20.0
width = 16
height = 16
[devices]
hardware_stepping = true
watchdog_s = 10.0
"""
    + DEVICES
    + """[capture.exposure]
dark = 0.005
all_on = 0.005
olat = 0.005
scanline = 0.005
tracking = 0.005
"""
)


def _bench(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    minutes = 0.2 if args.quick else args.minutes
    return run(args.out, minutes, args.seed, progress, quick=args.quick, table=args.table)


OPTIONS = (
    option("--minutes", "how long to shoot; 0: not at all", type=float, default=60.0),
    option("--no-table", "without load x fault", dest="table", action="store_false"),
)
BENCHMARK = Benchmark(_bench, OPTIONS)

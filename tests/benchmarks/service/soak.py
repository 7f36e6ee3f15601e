"""A service that shoots captures back to back and is killed now and then; then load x fault.

Leaves `soak.json`: memory and descriptors of the service at each capture's end, what became of each
capture, whether every frame reads back; and, of each fault under each load, how long a blackout
took, the frames that were lost, and whether the capture was finished, as a table in `loads.md` too.
"""

from __future__ import annotations

import argparse
import random
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.acquisition.rates import simulated
from benchmarks.command import Benchmark, option
from benchmarks.results import markdown, save
from benchmarks.service.faults import HEAD, Cell, cells
from benchmarks.service.live import Live
from reconstruction import Progress, verify
from stage_service.cli.support.children import Children

PLAN = {
    "lights": [f"light_{i:03d}" for i in range(60)],
    "projectors": [],
    "stepping": "software",
}
WAITING = 3
"""Captures that the queue is kept filled with."""
KILL_EVERY = 7
"""Of so many captures one meets a SIGKILL of the service."""


def run(
    out: Path, minutes: float, seed: int, progress: Progress, *, quick: bool = False
) -> dict[str, Any]:
    """Shoot for so long, then fill the table; returns what `soak.json` holds."""
    out.mkdir(parents=True, exist_ok=True)
    result: dict[str, Any] = {"minutes": minutes, "captures": [], "cells": []}
    with TemporaryDirectory(dir=out) as scratch, simulated(RIG) as rig:
        folder = Path(scratch)
        with Children(folder / "logs") as children:
            if minutes > 0:
                live = Live(rig, children, folder / "root")
                _shoot(live, minutes, random.Random(seed), result, progress)
                live.end()
                save(out / "soak.json", result)
            found: list[Cell] = []
            for cell in cells(rig, children, folder, progress, quick=quick):
                found.append(cell)
                result["cells"] = [c.__dict__ for c in found]
                save(out / "soak.json", result)
                (out / "loads.md").write_text(markdown(HEAD, [c.row() for c in found]))
    return result


def _shoot(
    live: Live, minutes: float, rng: random.Random, result: dict[str, Any], progress: Progress
) -> None:
    begun, seen = time.monotonic(), set[str]()
    while time.monotonic() - begun < 60 * minutes:
        progress(f"{len(seen)} captures, {live.kills} kills", 0.5)
        queue = live.ask("GET", "/queue")
        if queue["held"]:
            _finish(live)
            live.ask("POST", "/queue:go-on")
        for _ in range(WAITING - len(queue["waiting"])):
            live.ask("POST", "/queue", {"plan": PLAN})
        going = live.ask("GET", "/health")["capture"]
        if going and going not in seen:
            seen.add(going)
            result["captures"].append({"id": going, **live.size()})
            if len(seen) % KILL_EVERY == 0:
                time.sleep(rng.uniform(0.0, 1.0))
                live.kill()
                live.begin()
        time.sleep(0.1)
    _empty(live)
    result.update(_judge(live), kills=live.kills)


def _finish(live: Live) -> None:
    """Let what a kill interrupted shoot what it lacks."""
    for capture in live.ask("GET", "/captures"):
        if capture["outcome"] == "interrupted":
            live.ask("POST", f"/captures/{capture['id']}/resume", {})
            live.until_done(capture["id"])


def _empty(live: Live) -> None:
    """Take out what waits, and let what runs end."""
    live.ask("POST", "/queue:hold")
    for entry in live.ask("GET", "/queue")["waiting"]:
        live.ask("DELETE", f"/queue/{entry['id']}")
    if going := live.ask("GET", "/health")["capture"]:
        live.until_done(going)
    _finish(live)
    live.ask("POST", "/queue:go-on")


def _judge(live: Live) -> dict[str, Any]:
    """Every capture read again: outcomes, frames, and what is wrong."""
    outcomes: dict[str, int] = {}
    frames, wrong = 0, []
    for capture in live.ask("GET", "/captures"):
        outcomes[capture["outcome"]] = outcomes.get(capture["outcome"], 0) + 1
        frames += capture["frames_written"]
        wrong += [f"{capture['id']}: {problem}" for problem in verify(capture["path"])]
    return {"outcomes": outcomes, "frames": frames, "wrong": wrong, "at_the_end": live.size()}


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
[devices.lights]
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
[capture.exposure]
dark = 0.005
all_on = 0.005
olat = 0.005
scanline = 0.005
tracking = 0.005
"""


def _bench(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    minutes = 0.2 if args.quick else args.minutes
    return run(args.out, minutes, args.seed, progress, quick=args.quick)


MINUTES = option("--minutes", "how long to shoot; 0: only the table", type=float, default=60.0)
BENCHMARK = Benchmark(_bench, (MINUTES,))

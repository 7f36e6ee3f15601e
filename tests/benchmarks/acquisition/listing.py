"""A root with many captures: seconds until the service answers, and for a page of them.

Leaves `captures.json`.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import statistics
import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import httpx
import numpy as np

from benchmarks.command import Benchmark, option
from benchmarks.results import save
from reconstruction import CaptureWriter, Progress, Step
from stage_service.api.app import create_app
from stage_service.cli.support.commands import rig_path
from stage_service.config import RigFile, load_rig_file
from stage_service.service import Service

START_S, PAGE_S = 5.0, 0.05
"""The goals."""
PAGE = 200
TIMES = 20


def measure(root: Path, rig_file: RigFile, count: int) -> dict[str, Any]:
    """Seconds from nothing to the first page, and until all captures are read: of a root that no
    service has seen, and of one that one has; and of a page after that, the median of some."""
    fill(root / "captures", rig_file, count)
    first, first_read, _ = _start(root, rig_file)
    again, read, pages = _start(root, rig_file)
    return {
        "captures": count,
        "page": min(PAGE, count),
        "first_start_s": first,
        "first_read_s": first_read,
        "start_s": again,
        "read_s": read,
        "start_goal_s": START_S,
        "page_s": statistics.median(pages),
        "page_slowest_s": max(pages),
        "page_goal_s": PAGE_S,
    }


def fill(folder: Path, rig_file: RigFile, count: int) -> None:
    """Captures of two frames on this rig. All are one on the disk, under many names."""
    cameras = (replace(rig_file.rig.cameras[0], width=4, height=4),)
    rig = replace(rig_file.rig, cameras=cameras)
    names = [light.name for light in rig.lights[:2]]
    steps = tuple(Step(i, "olat", 0.01, light=name) for i, name in enumerate(names))
    template = folder / "20260101-000000-0000"
    writer = CaptureWriter.create(template, rig, {"steps": steps})
    for step in steps:
        writer.write_frame(step, cameras[0].name, np.zeros((4, 4, 3), np.float32))
    writer.finish("completed")
    for number in range(1, count):
        made = folder / f"20260101-000000-{number:04x}"
        made.mkdir()
        for file in ("plan.json", "rig.json", "journal.jsonl", "manifest.json"):
            os.link(template / file, made / file)


def _start(root: Path, rig_file: RigFile) -> tuple[float, float, list[float]]:
    begin = time.perf_counter()
    service = Service(rig_file, root)
    service.start()
    try:
        return asyncio.run(_pages(service, begin))
    finally:
        service.close()


async def _pages(service: Service, begin: float) -> tuple[float, float, list[float]]:
    """Seconds since `begin` when the first page is there, and all captures are read; and those of
    more pages."""
    transport, seconds = httpx.ASGITransport(create_app(service)), []
    async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as http:

        async def page() -> None:
            answer = await http.get("/captures", params={"limit": PAGE})
            answer.raise_for_status()

        await page()
        first = time.perf_counter() - begin
        while service.unread:
            await asyncio.sleep(0.02)
        read = time.perf_counter() - begin
        for _ in range(TIMES):
            start = time.perf_counter()
            await page()
            seconds.append(time.perf_counter() - start)
    return first, read, seconds


def run_listing(args: argparse.Namespace, _progress: Progress) -> dict[str, Any]:
    """Measure, and keep the figures."""
    rig_file = replace(load_rig_file(rig_path("stage331")), devices=None)
    with TemporaryDirectory(dir=args.out, prefix="bench-captures-") as root:
        result = measure(Path(root), rig_file, 100 if args.quick else args.captures)
    save(args.out / "captures.json", result)
    return result


BENCHMARK = Benchmark(run_listing, (option("--captures", "how many", type=int, default=10_000),))

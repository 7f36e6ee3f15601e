"""The viewer: how near its light is to the path tracer's, and how fast it draws.

Leaves `viewer.json` and a picture of each groom, written after each light.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.command import ONLY, Benchmark, LeftOut, option, within
from benchmarks.renderers.cost import with_count
from benchmarks.results import save
from benchmarks.subjects import simulated
from benchmarks.viewer.agreement import Effort, compare, write
from benchmarks.viewer.page import viewers
from benchmarks.viewer.speed import measure
from reconstruction import Progress
from reconstruction.arrays import Array
from stage_service.cli.support.commands import rig_path

GROOMS: tuple[str, ...] = ("straight", "wavy", "curly")
COUNTS: tuple[int, ...] = (26_000, 100_000)
GOALS = {"psnr_db": 24, "direct_over_path_tracer": (0.98, 1.02), "frames_a_second_gpu": (60, 30)}


def run(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Agreement of each groom under four lights, then frames a second at each number of strands."""
    if args.only not in (None, *GROOMS):
        raise LeftOut(f"no subject {args.only!r}; there are {', '.join(GROOMS)}")
    grooms, counts = tuple(n for n in GROOMS if args.only in (None, n)), COUNTS
    effort, seconds = Effort(args.size, args.spp, args.over, args.samples), args.seconds
    if args.quick:
        grooms, counts, effort, seconds = ("straight",), (2000,), Effort(32, 8, 1, 3), 1.0
    rig = rig_path("demo")
    subjects = {name: simulated(rig, name, None, args.seed) for name in grooms}
    if args.quick:  # a browser without a GPU draws a whole groom for minutes
        few = subjects["straight"].strands.subset(np.arange(0, 10_000, 5))
        subjects = {"straight": replace(subjects["straight"], strands=few)}
    result: dict[str, Any] = {"goals": GOALS, "effort": vars(effort), "agreement": {}, "speed": {}}
    with viewers() as opened:
        for k, (name, subject) in enumerate(subjects.items()):
            begin = time.monotonic()
            part = within(progress, name, 0.3 * k, 0.3)
            result["agreement"][name], pictures = {}, list[Array]()
            with opened(subject) as shown:
                for light, figures, picture in compare(shown, subject.scene(), effort, part):
                    pictures.append(picture)
                    result["agreement"][name][light] = figures
                    write(args.out / f"viewer_{name}.png", np.vstack(pictures))
                    save(args.out / "viewer.json", result)
            result["agreement"][name]["seconds"] = time.monotonic() - begin
        for count in counts:
            progress(f"{count} strands", 0.95)
            some = next(iter(subjects.values()))
            many = replace(some, strands=with_count(some.strands, count, args.seed))
            with opened(many) as shown:
                result["speed"][str(count)] = measure(shown, seconds)
            save(args.out / "viewer.json", result)
    return result


OPTIONS = (
    ONLY,
    option("--size", "pixels a side of the pictures that are compared", type=int, default=128),
    option("--spp", "paths a pixel of the path tracer's", type=int, default=1024),
    option("--over", "of the viewer's pixels a side are one of those", type=int, default=4),
    option("--samples", "of each of the viewer's pictures; it takes 48", type=int, default=24),
    option("--seconds", "that each way of drawing is measured", type=float, default=15.0),
)
BENCHMARK = Benchmark(run, OPTIONS)

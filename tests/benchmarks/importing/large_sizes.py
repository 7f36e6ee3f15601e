"""What a reconstruction takes, by stage, beside what `--estimate` said: captures of all sizes.

Frames are painted as they are read (`painted`), which takes about as long as decoding them. The
two large sizes are a stage's, 16 cameras of 1.3 megapixels with 331 lights and three sweeps of 768
rows, and a studio's, 24 of 20 megapixels with 36 lights, worked on at a quarter of its pixels a
side (six of the cameras, then all) and whole. Leaves `large.json`.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.command import Benchmark, option, within
from benchmarks.importing.drawn import DrawnCapture
from benchmarks.results import save
from reconstruction import Camera, Model, Progress, Rig, reconstruct
from reconstruction.estimate import estimate
from reconstruction.methods import METHODS, Method
from stage_service.cli.support.commands import rig_path
from stage_service.config import load_rig_file

MEMORY_GB = 16.0
"""The goal: no stage takes more."""
WITHIN = 0.3
"""The goal: seconds and memory are within this share of what the estimate said."""


@dataclass(frozen=True)
class Size:
    """Every so many of the cameras and lights of the rig "stage331", its pictures `scaled`."""

    cameras: int
    lights: int
    scaled: float
    sweep: bool
    reduced: int = 1

    def rig(self) -> Rig:
        """The rig; cameras and lights are spread over all of it."""
        whole = load_rig_file(rig_path("stage331")).rig
        return replace(
            whole,
            cameras=tuple(_scaled(c, self.scaled) for c in _spread(whole.cameras, self.cameras)),
            lights=_spread(whole.lights, self.lights),
            projectors=whole.projectors if self.sweep else (),
        )


SIZES = {
    "small": Size(8, 64, 0.125, sweep=False),
    "photographs": Size(12, 64, 0.25, sweep=False),
    "stage": Size(16, 331, 1.0, sweep=True),
    "studio_part": Size(6, 36, 3.87, sweep=False, reduced=4),
    "studio_quarter": Size(24, 36, 3.87, sweep=False, reduced=4),
    "studio": Size(24, 36, 3.87, sweep=False),
}


def measure(
    size: Size, method: Method, folder: Path, seed: int, progress: Progress
) -> dict[str, Any]:
    """The estimate and the run of one capture; stages are told beside what they took."""
    drawn = DrawnCapture.write(
        folder / "capture", size.rig(), sweep=size.sweep, all_on=size.sweep, seed=seed
    )
    capture = drawn.view(reduced=size.reduced)
    estimated = estimate(capture, method=method, progress=within(progress, "estimate", 0.0, 0.05))
    report_progress = within(progress, "reconstruct", 0.05, 0.9)  # where it ends, bars say no more
    report = reconstruct(capture, Model(folder / "model"), method=method, progress=report_progress)
    taken = {s.name: {"seconds": s.seconds, "peak_gb": s.peak_gb or 0.0} for s in report.stages}
    for stage in estimated.stages:
        if mine := taken.get(stage.name):
            mine["seconds_over_estimate"] = mine["seconds"] / max(stage.seconds, 1.0)
            mine["peak_over_estimate"] = mine["peak_gb"] / stage.peak_gb
    seconds = sum(s["seconds"] for s in taken.values())
    peak = max(s["peak_gb"] for s in taken.values())
    return {
        "size": asdict(size),
        "estimated": asdict(estimated)
        | {"seconds": estimated.seconds, "peak_gb": estimated.peak_gb},
        "taken": {"stages": taken, "seconds": seconds, "peak_gb": peak},
        "seconds_over_estimate": seconds / estimated.seconds,
        "peak_over_estimate": peak / estimated.peak_gb,
        "goals": {"peak_gb": MEMORY_GB, "within": WITHIN},
    }


def run(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Run the benchmark."""
    results: dict[str, Any] = {}
    for name in ["small"] if args.quick else args.sizes:
        size = replace(SIZES[name], lights=12, cameras=4) if args.quick else SIZES[name]

        for method in args.methods:
            row = f"{name}, {method}"

            def report_progress(what: str, share: float, row: str = row) -> None:
                progress(f"{row}: {what}", share)

            with TemporaryDirectory(dir=args.out) as folder:
                results[row] = measure(size, method, Path(folder), args.seed, report_progress)
            save(args.out / "large.json", results)
    return results


def _spread(items: tuple[Any, ...], count: int) -> tuple[Any, ...]:
    return tuple(items[k * len(items) // count] for k in range(count))


def _scaled(camera: Camera, by: float) -> Camera:
    """The same view on `by` times as many pixels a side."""
    K = camera.K.copy()
    K[:2] *= by
    K[:2, 2] += 0.5 * by - 0.5
    width, height = round(camera.width * by), round(camera.height * by)
    return replace(camera, K=K, width=width, height=height)


SIZE = option(
    "--sizes", "which captures", nargs="+", choices=SIZES, default=["small", "photographs"]
)
HOW = option("--methods", "of reconstruction", nargs="+", choices=METHODS, default=["auto"])
BENCHMARK = Benchmark(run, (SIZE, HOW))

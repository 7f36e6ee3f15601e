"""Cost against size: CPU seconds and memory of frames and fits, compared with their estimates.

Each job is a process of its own, on one core or thread, whose clock counts CPU seconds: other work
on the machine does not count. Leaves `cost.json` and `cost.md`.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appearance import HairScene
from appearance.render.coverage import coverage
from benchmarks.command import Benchmark, option
from benchmarks.results import markdown, save
from benchmarks.subjects import Subject
from reconstruction import Camera, CaptureWriter, Light, Model, Progress, Rig, Step, Strands
from reconstruction.arrays import Ints
from reconstruction.geometry.lights import dome_positions
from simulators.frames.render_process import RenderProcess
from simulators.frames.responses import MitsubaResponder, Quality, frames_memory, reproducible
from simulators.frames.work import COSTS, predicted_seconds
from simulators.subject.drift import Drift
from simulators.subject.subject import Subject as Simulated
from simulators.subject.subject import make_subject


@dataclass(frozen=True)
class Effort:
    """How much the benchmark measures; the defaults take a quarter of an hour on two cores."""

    lights: Sequence[int] = (8, 36, 331)
    pixels: int = 2000
    spp: Sequence[int] = (4, 16, 48)
    path_spp: Sequence[int] = (4, 8)
    reference_spp: int = 128


@dataclass(frozen=True)
class View:
    """What is rendered: the flat pixels `index (P,)` of a camera's picture."""

    scene: HairScene
    camera: Camera
    index: Ints
    seed: int

    @classmethod
    def of(cls, subject: Subject, camera: Camera, pixels: int, seed: int) -> View:
        """At most `pixels` of hair in a subject's picture."""
        scene = subject.scene()
        return cls(scene, camera, hair_pixels(scene, camera, pixels, seed), seed)


def hair_pixels(
    scene: HairScene, camera: Camera, count: int, seed: int, least: float = 0.5
) -> Ints:
    """At most `count` pixels of which hair covers more than `least`, in random places, sorted."""
    covered = np.flatnonzero(coverage(scene, camera)["hair"].ravel() > least)
    if not len(covered):
        raise ValueError(f"{camera.name} does not see the hair: nothing to measure")
    return np.sort(np.random.default_rng(seed).permutation(covered)[:count])


def with_count(strands: Strands, count: int, seed: int) -> Strands:
    """`count` of the strands, or copies of them a few millimetres aside, at the same coverage."""
    rng = np.random.default_rng(seed)
    whole, rest = divmod(count, len(strands))
    chosen = np.r_[np.tile(np.arange(len(strands)), whole), rng.permutation(len(strands))[:rest]]
    pieces = [strands.points[strands.offsets[i] : strands.offsets[i + 1]] for i in chosen]
    aside = rng.normal(scale=0.001, size=(count, 3)).astype(np.float32)
    if whole:
        aside[: len(strands)] = 0
    radius = float(np.mean(strands.radius)) * len(strands) / count
    moved = Strands.from_list([p + a for p, a in zip(pieces, aside, strict=True)])
    return replace(moved, radius=radius)


SPP = 4
"""Paths a pixel of the frames that are fitted."""


@dataclass(frozen=True)
class Size:
    """Cameras of `side`² pixels, lights, strands, and most vertices of a path.

    `block`² pixels of the frames that a fit reads are one rendered pixel, repeated. `points` of a
    strand, on average; 0: the groom's.
    """

    side: int = 192
    lights: int = 24
    strands: int = 10_000
    bounces: int = 16
    cameras: int = 1
    block: int = 1
    points: int = 0

    def rig(self) -> Rig:
        """Cameras in an arc around the head's back and sides, and a dome of lights."""
        angles = np.linspace(-0.7, 0.7, self.cameras) * np.pi if self.cameras > 1 else [0.0]
        cameras = (
            Camera.look_at(
                f"cam_{k:02d}",
                self.side,
                self.side,
                (0.95 * np.sin(a), -0.95 * np.cos(a), 0.1),
                (0, 0, -0.03),
                25.0,
            )
            for k, a in enumerate(angles)
        )
        places = enumerate(dome_positions(self.lights, 1.2, -30.0))
        lights = (Light(f"light_{i:03d}", p, np.full(3, 8.0)) for i, p in places)
        return Rig("cost", tuple(cameras), tuple(lights), ())

    def subject(self, seed: int) -> Simulated:
        """The groom "wavy" at the same coverage."""
        subject = make_subject("wavy", seed, self.strands)
        if not self.points:
            return subject
        step = float(subject.strands.lengths().mean()) / (self.points - 1)
        return replace(subject, strands=subject.strands.resampled(step))


BASE = Size()
AXES: dict[str, tuple[int, ...]] = {
    "side": (96, 384),
    "lights": (6, 96),
    "strands": (50_000, 150_000),
    "bounces": (1, 4),
}
ALL = "sun,shared,spatial,correctives,lights,field"
FITS = {
    Size(96, 16, 5_000, cameras=4): ALL,
    Size(128, 24, 20_000, cameras=8): "sun,field",
}
"""Stages of fits: those of the second take longer with each camera."""
FULL = Size(512, 160, 50_000, cameras=48, block=4, points=100)
"""A capture and strands of GroomLight's size."""
QUICK = Size(64, 24, 1_000, 4, cameras=2)
_LITTLE = {"fit": {"hair_pixels": 800, "iterations": 1, "error_paths": 1, "roughness_spp": 2}}


def run(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    """Frames over each axis, then fits of two sizes; rows of estimated and measured figures."""
    base, axes, fits, options = BASE, AXES, FITS, {}
    if args.quick:
        base, axes, fits, options = QUICK, {"strands": (2_000,)}, {QUICK: "sun"}, _LITTLE
    frames = [base, *(replace(base, **{name: x}) for name, xs in axes.items() for x in xs)]
    if args.full:
        frames, fits = [], {FULL: ALL}
    rows: list[dict[str, Any]] = []
    for k, size in enumerate([*frames, *fits]):
        fit = k >= len(frames)
        progress(f"{'fit' if fit else 'frames'}: {size}", k / (len(frames) + len(fits)))
        rows += _fit(size, args.seed, fits[size], options) if fit else _frames(size, args.seed)
        save(args.out / "cost.json", {"seed": args.seed, "rows": rows})
    (args.out / "cost.md").write_text(_table(rows))
    return {"seed": args.seed, "rows": rows}


def _table(rows: Sequence[dict[str, Any]]) -> str:
    """Markdown: estimated over measured beside the measured figures."""
    head = ["job", "cameras", "side", "lights", "strands", "bounces", "CPU s", "est. : measured"]

    def cells(row: dict[str, Any]) -> list[object]:
        size, found = row["size"], [row["job"]]
        found += [size[k] for k in ("cameras", "side", "lights", "strands", "bounces")]
        for name, digits in (("seconds", 1), ("gb", 2)):
            found += [f"{row[name]:.{digits}f}", f"{row[f'estimated_{name}'] / row[name]:.2f}"]
        return found

    return markdown([*head, "GB", "est. : measured"], map(cells, rows))


def _frames(size: Size, seed: int) -> list[dict[str, Any]]:
    """A camera's frames of a simulated rig under each light, in the rig's own rendering process."""
    rig, subject, quality = size.rig(), size.subject(seed), Quality(depth=size.bounces)
    camera, drift = rig.cameras[0], Drift(1, 0.0, seed)
    before = _seconds_of_children()
    process = RenderProcess(partial(reproducible, rig, subject, drift, quality, seed))
    try:
        process.lights(camera.name)
        status = Path(f"/proc/{process._process.pid}/status").read_text()
    finally:
        process.stop()
    most = next(int(x.split()[1]) for x in status.splitlines() if x.startswith("VmHWM"))
    estimated = predicted_seconds("lights", camera, len(rig.lights), quality)
    row = {
        "seconds": _seconds_of_children() - before,
        "estimated_seconds": estimated + COSTS["lights"].first,
        "gb": most * 1024 / 1e9,
        "estimated_gb": frames_memory(rig, subject),
    }
    return [{"job": "frames", "size": asdict(size), **row}]


def _seconds_of_children() -> float:
    """CPU seconds of the processes that ended."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def _fit(size: Size, seed: int, stages: str, options: dict[str, Any]) -> list[dict[str, Any]]:
    """Stages of `hairstage fit` on true strands, and what `--estimate` says of them."""
    with TemporaryDirectory() as folder:
        capture, model = (Path(folder) / name for name in ("capture", "model"))
        _shoot(size, seed, capture, model)
        command = ["fit", str(capture), str(model), "--seed", str(seed), "--json"]
        command += ["--stages", stages, "--options", json.dumps(options)]
        estimated = {x["name"]: x for x in _command([*command, "--estimate"])["stages"]}
        done = _command(command)
        report = {x["name"]: x for x in Model(model).json("report.json")["stages"]}
    parts = {"sun": ("samples", "roughness", "colour")}
    seconds = {x["stage"]: x["seconds"] for x in done["stages"] if x["stage"] != "field"}
    rows = []
    for name, stage in estimated.items():
        of_stage = [report[p] for p in parts.get(name, (name,)) if p in report]
        found = of_stage or [report["inverse_rendering"]]
        row = {
            "seconds": seconds.get(name) or sum(x["seconds"] for x in found),
            "estimated_seconds": stage["seconds"],
            "gb": max(x["peak_gb"] for x in found),
            "estimated_gb": stage["peak_gb"],
        }
        rows.append({"job": f"fit, {name}", "size": asdict(size), **row})
    return rows


def _shoot(size: Size, seed: int, capture: Path, model: Path) -> None:
    """Write the capture of a simulated rig, and a model with its true strands."""
    rig, subject = size.rig(), size.subject(seed)
    small = replace(size, side=size.side // size.block).rig()
    responder = MitsubaResponder(small, subject, Drift(1, 0.0, seed), Quality.scaled(SPP), seed)
    steps = [Step(i, "olat", 0.02, light=x.name) for i, x in enumerate(rig.lights)]
    plan = {"steps": [s.to_dict() for s in steps]}
    writer = CaptureWriter.create(capture, rig, plan, head=subject.head)
    made = Model(model).create()
    made.write_strands(subject.strands)
    for camera in small.cameras:
        response = responder.lights(camera.name)
        for step in steps:
            image = np.zeros((camera.height * camera.width, 3), np.float32)
            image[response.pixels] = response.image(step.index)
            shape = (camera.height, camera.width, 3)
            writer.write_frame(step, camera.name, _enlarged(image.reshape(shape), size.block))
        hair = coverage(responder._scene, camera)["hair"] > 0.5
        made.write_mask(camera.name, "hair", _enlarged(hair, size.block))
    writer.finish("completed", {})


def _enlarged(image: NDArray[Any], block: int) -> NDArray[Any]:
    """Each pixel of `image (H, W, ...)` as `block`² equal ones."""
    return image.repeat(block, axis=0).repeat(block, axis=1)


def _command(arguments: Sequence[str]) -> dict[str, Any]:
    """The JSON that a command of `hairstage` prints."""
    return _child(
        f"import sys; from stage_service.cli import main; sys.exit(main({list(arguments)!r}))"
    )


def _child(code: str) -> dict[str, Any]:
    """The JSON that Python `code` prints in a process of its own; see the module's text."""
    clock = "import os, time; time.perf_counter = time.process_time"
    core = "os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:1])"
    command = [sys.executable, "-c", f"{clock}; {core}; {code}"]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{code}: {done.stderr.strip()}")
    found: dict[str, Any] = json.loads(done.stdout)
    return found


BENCHMARK = Benchmark(
    run, (option("--full", "only the fit of a capture of GroomLight's size", action="store_true"),)
)

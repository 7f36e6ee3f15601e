"""A model's exports in Blender: what it finds in them, Cycles' colours beside ours, and its own
exporters beside ours on 100,000 strands.

Needs `--blender`, a Python that has bpy (`pip install bpy==4.5.*` in an environment of its own).
Leaves `exports.json`, `exports.md` and `exports.png`: lights in rows, ours left, Cycles right.
Strands that were made thick run through each other, where renderers differ; so colours are
compared once more with hair a quarter as thick.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import OpenImageIO as oiio

from appearance import Exposure, FittedModel, render_olat
from appearance.export.blender import export_blender
from appearance.export.groom import Groom
from appearance.export.options import ExportOptions
from appearance.export.unreal import export_unreal
from appearance.export.usd import export_usd
from appearance.model.relight import three_quarter_view
from appearance.render.coverage import coverage
from benchmarks.command import Benchmark, LeftOut, option
from benchmarks.results import markdown, save
from reconstruction import Camera, Capture, Light, Model, Progress, Strands, write_strands
from reconstruction.arrays import AnyFloats, Array, Bools, Floats

IN_BPY = Path(__file__).with_name("in_bpy.py")
DEPTH = 64
THINNER = {"as it is": 1.0, "a quarter as thick": 0.25}
GOAL = 0.1
"""Of ours: what Cycles' mean colour may be off."""
PARTS = ("hair", "skin")
MANY = 100_000


@dataclass(frozen=True)
class Effort:
    """Paths a pixel, pixels a side, and strands for exporters."""

    spp: int = 256
    size: int = 160
    many: int = MANY


def _bench(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    if args.blender is None:
        raise LeftOut("name with --blender a Python that has bpy (pip install bpy==4.5.*)")
    if not (args.model / "appearance.json").is_file():
        raise LeftOut(f"no fitted model at {args.model}: 'make demo' makes one, or name --model")
    effort = Effort(16, 64, 1000) if args.quick else Effort()
    capture = Capture(args.capture)
    fitted = FittedModel.load(Model(args.model), capture)
    work: Path = args.out / "exports"
    work.mkdir(parents=True, exist_ok=True)
    result: dict[str, Any] = {"strands": len(fitted.strands), "points": len(fitted.strands.points)}

    def keep(**more: Any) -> None:
        result.update(more)
        save(args.out / "exports.json", result)

    def run_job(job: dict[str, Any]) -> dict[str, Any]:
        return _in_blender(args.blender, work, job)

    progress("what Blender finds", 0.0)
    keep(opened=_opened(fitted, Groom.load(Model(args.model), capture), work, run_job))
    progress("colours", 0.2)
    colours, picture = _colours(fitted, capture, effort, work, run_job)
    keep(colours=colours)
    cv2.imwrite(str(args.out / "exports.png"), picture[..., ::-1])
    progress(f"{effort.many:,} strands", 0.7)
    keep(exporters=_exporters(fitted, effort.many, work, run_job))
    (args.out / "exports.md").write_text(tables(result))
    return result


def _in_blender(python: Path, work: Path, job: dict[str, Any]) -> dict[str, Any]:
    """The answer of `in_bpy.py`. Raises `LeftOut` with what Blender said."""
    file = work / "job.json"
    file.write_text(json.dumps(job))
    done = subprocess.run([python, IN_BPY, file], capture_output=True, text=True)
    if done.returncode:
        raise LeftOut(f"{python}: {(done.stderr or done.stdout)[-600:]}")
    outcome: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return outcome


RunJob = Callable[[dict[str, Any]], dict[str, Any]]


def _opened(fitted: FittedModel, groom: Groom, work: Path, run_job: RunJob) -> dict[str, Any]:
    """By export: counts, radius in metres, and how far its box and its head's are off, metres."""
    files = {"abc": work / "hair.abc", "usd": work / "hair.usdc", "blender": work / "blender"}
    write_strands(files["abc"], groom.strands)
    export_usd(groom, files["usd"])
    export_blender(groom, files["blender"])
    found = run_job({"open": {name: str(file) for name, file in files.items()}})
    for name, row in found.items():
        row["box_off"] = _off(row, groom.strands.points)
        if "head" in row and fitted.head is not None:
            row["head_off"] = _off(row.pop("head"), fitted.head.vertices)
        row["true_radius"] = float(np.mean(groom.strands.radius))
        row["bytes"] = _size(files[name])
    return found


def _off(box: dict[str, Any], points: AnyFloats) -> float:
    low, high = np.array(box.pop("low")), np.array(box.pop("high"))
    return float(np.abs([low - points.min(axis=0), high - points.max(axis=0)]).max())


def _size(path: Path) -> int:
    files = [path] if path.is_file() else list(path.iterdir())
    return sum(f.stat().st_size for f in files)


def _colours(
    fitted: FittedModel, capture: Capture, effort: Effort, work: Path, run_job: RunJob
) -> tuple[dict[str, Any], Array]:
    """Cycles' mean radiance over ours, of hair and of skin, by thickness and light; a picture."""
    camera = three_quarter_view(fitted.strands, effort.size)
    lights = _lights(capture.rig.lights, camera)
    ratios: dict[str, Any] = {}
    rows = []
    for thickness, thinner in THINNER.items():
        strands = replace(fitted.strands, radius=fitted.strands.radius * thinner)
        scene = replace(fitted, strands=strands).without_field().scene()
        covered = coverage(scene, camera)
        ours = render_olat(scene, camera, list(lights.values()), spp=effort.spp, max_depth=DEPTH)
        view = {
            "groom": str(work / "blender"),
            "thinner": thinner,
            "spp": effort.spp,
            "depth": DEPTH,
            **_lens(camera),
            "lights": {
                name: {
                    "position": light.position.tolist(),
                    "intensity": light.intensity.tolist(),
                    "out": str(work / f"{name}.exr"),
                }
                for name, light in lights.items()
            },
        }
        seconds = run_job({"render": {"cycles": view}})["cycles"]
        ratios[thickness] = {}
        for mine, name in zip(ours, lights, strict=True):
            theirs = _read(work / f"{name}.exr")
            ratios[thickness][name] = {
                "hair": _ratio(theirs, mine, covered["hair"] > 0.5),
                "skin": _ratio(theirs, mine, covered["head"] > 0.99),
                **seconds[name],
            }
            show = Exposure.of([mine[covered["hair"] > 0.5]])
            rows.append(np.hstack([show(mine), show(theirs)]))
    return ratios, np.rint(255 * np.vstack(rows)).astype(np.uint8)


def _lights(lights: Sequence[Light], camera: Camera) -> dict[str, Light]:
    """Those nearest to before, beside and behind the head, as the camera sees it."""
    eye = camera.center / np.linalg.norm(camera.center)
    ways = np.array([x.position / np.linalg.norm(x.position) for x in lights])
    places = {"front": eye, "side": np.cross(eye, [0, 0, 1.0]), "behind": -eye}
    return {name: lights[int((ways @ way).argmax())] for name, way in places.items()}


def _lens(camera: Camera) -> dict[str, Any]:
    return {
        "K": camera.K.tolist(),
        "R": camera.R.tolist(),
        "t": camera.t.tolist(),
        "size": [camera.width, camera.height],
    }


def _read(path: Path) -> Array:
    pixels = oiio.ImageBuf(str(path)).get_pixels()
    if pixels is None:
        raise LeftOut(f"{path} cannot be read: Cycles rendered nothing")
    return np.asarray(pixels, float)[..., :3]


def _ratio(theirs: Array, ours: Floats, mask: Bools) -> list[float]:
    """Of the mean radiance, R, G, B; empty where nothing of it is seen or it lies in the dark."""
    mean = ours[mask].mean(axis=0) if mask.any() else np.zeros(3)
    lit = mean.min() > 1e-3 * ours.max()
    return [float(x) for x in theirs[mask].mean(axis=0) / mean] if lit else []


def _exporters(fitted: FittedModel, many: int, work: Path, run_job: RunJob) -> dict[str, Any]:
    """Seconds and bytes of our exporters and of Blender's, of `many` strands."""
    times = -(-many // len(fitted.strands))
    moved = np.random.default_rng(0).normal(scale=1e-3, size=(times, 3)).astype(np.float32)
    every = fitted.strands.subset(np.tile(np.arange(len(fitted.strands)), times)[:many])
    first = np.repeat(np.arange(times), len(fitted.strands))[:many]
    shift = moved[np.repeat(first, np.diff(every.offsets))]
    strands = Strands(every.points + shift, every.offsets, float(np.mean(fitted.strands.radius)))
    placed = np.tile(fitted.root_uv, (times, 1))[:many]
    groom = Groom.of(replace(fitted, strands=strands, placed=placed), ExportOptions())
    out: dict[str, Any] = {"strands": many, "points": len(strands.points)}
    ours: dict[str, tuple[str, Callable[[Path], Any]]] = {
        "abc, strands": ("many.abc", lambda path: write_strands(path, strands)),
        "abc, unreal": ("many_unreal.abc", lambda path: export_unreal(groom, path)),
        "usd": ("many.usdc", lambda path: export_usd(groom, path)),
    }
    for name, (file, write) in ours.items():
        wall, cpu = time.perf_counter(), time.process_time()
        write(work / file)
        seconds = {"seconds": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu}
        out[f"ours, {name}"] = {**seconds, "bytes": _size(work / file)}
    export_blender(groom, work / "many")
    theirs = {"abc": work / "theirs.abc", "usd": work / "theirs.usdc"}
    job = {"groom": str(work / "many"), "abc": str(theirs["abc"]), "usd": str(theirs["usd"])}
    for name, row in run_job({"write": job})["write"].items():
        out[f"Blender's, {name}"] = {**row, "bytes": _size(theirs[name])}
    return out


def tables(result: dict[str, Any]) -> str:
    """The three tables of `exports.md`."""
    opened = [
        [
            name,
            f"{row['curves']:,} of {result['strands']:,}",
            f"{row['points']:,} of {result['points']:,}",
            f"{1e3 * row['box_off']:.3f}",
            f"{row['radius'] / row['true_radius']:.4f}",
            f"{1e3 * row['head_off']:.3f}" if "head_off" in row else "none",
            ", ".join(row["material"]) or "none",
            f"{row['seconds']:.2f}",
        ]
        for name, row in result["opened"].items()
    ]
    head = ("file", "curves", "points", "box off, mm", "radius", "head off, mm", "material", "s")
    colours = [
        [
            thickness,
            light,
            *(" / ".join(f"{x:.3f}" for x in row[part]) for part in PARTS),
            _judged(row["hair"]),
        ]
        for thickness, lights in result["colours"].items()
        for light, row in lights.items()
    ]
    size = result["exporters"]
    exporters = [
        [name, f"{row['seconds']:.1f}", f"{row['cpu_s']:.1f}", f"{row['bytes'] / 1e6:.1f}"]
        for name, row in size.items()
        if isinstance(row, dict)
    ]
    return "\n".join(
        [
            "What Blender finds in each export.\n",
            markdown(head, opened),
            f"Cycles' mean colour over ours, R / G / B; goal: within {GOAL:.0%}.\n",
            markdown(("hair", "light", *PARTS, "goal"), colours),
            f"{size['strands']:,} strands of {size['points']:,} points.\n",
            markdown(("exporter", "s", "CPU s", "MB"), exporters),
        ]
    )


def _judged(ratios: list[float]) -> str:
    if not ratios:
        return "in the dark"
    return "met" if max(abs(x - 1) for x in ratios) <= GOAL else "missed"


BENCHMARK = Benchmark(
    _bench,
    (
        option("--blender", "a Python that has bpy", type=Path),
        option("--model", "a fitted model", type=Path, default=Path("runs/demo/model")),
        option("--capture", "its capture", type=Path, default=Path("runs/demo/capture")),
    ),
)

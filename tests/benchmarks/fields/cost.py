"""CPU seconds and memory of a field's fit, by its size."""

from __future__ import annotations

import resource
import time
from pathlib import Path
from typing import Any

import numpy as np

from appearance.fields.anchors import Places
from appearance.fields.fit import Monitor, fit_pictures
from appearance.fields.hits import RECORD, Hits
from appearance.fields.options import FieldRequest
from appearance.fields.pictures import Pictures
from appearance.fields.pipeline import memory_needed
from reconstruction import Camera, Light, Progress
from reconstruction.arrays import Array
from reconstruction.geometry.lights import dome_positions

STRANDS = 10_000
RADIUS = 0.1


def cost(size: tuple[int, int, int], folder: Path, seed: int, progress: Progress) -> dict[str, Any]:
    """CPU seconds and peak memory of a whole fit to synthetic pictures.

    `size`: hair pixels a view, views, lights. Hits are on strands of a sphere, the captured
    pictures the rendered ones times a factor that varies with the place, and noise of 3 %;
    rendered ones are mapped from a file in `folder`, as those of a capture are. The peak is the
    process's, and has the mapped pages that are resident.
    """
    pixels, count, many = size
    rng = np.random.default_rng(seed)
    lights = tuple(
        Light(f"l{i}", p, np.full(3, 8.0)) for i, p in enumerate(dome_positions(many, 1.2))
    )
    roots = rng.uniform(size=(STRANDS, 2))
    request = FieldRequest()
    views = [
        _view(k * 2 * np.pi / count, (pixels, request.hits), lights, roots, folder, rng)
        for k in range(count)
    ]
    marks: list[tuple[str, float]] = []

    def show_progress(what: str, share: float) -> None:
        name = "validation" if what.startswith("ridge") else what.split(": ")[-1]
        if not marks or marks[-1][0] != name:
            marks.append((name, time.process_time()))
        progress(what, share)

    begun, before = time.process_time(), _peak()
    found = fit_pictures(views, Places.of(roots), 1.0, request.fit, Monitor(show_progress))
    ended = time.process_time()
    for view in views:
        (folder / f"{view.hits.camera.name}.npy").unlink()
    ends = [at for _, at in marks[1:]] + [ended]
    parts: dict[str, float] = {}
    for (name, at), end in zip(marks, ends, strict=True):
        parts[name] = parts.get(name, 0.0) + end - at
    return {
        "pixels": pixels,
        "views": count,
        "lights": many,
        "cpu_seconds": ended - begun,
        "parts": parts,
        "peak_gb": _peak(),
        "peak_gb_before": before,
        "predicted_gb": memory_needed([pixels] * count, many, STRANDS, request),
        "decision": found.decision.to_dict(),
        "tried": len(found.tried),
    }


def _peak() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def _view(
    angle: float,
    shape: tuple[int, int],
    lights: tuple[Light, ...],
    roots: Array,
    folder: Path,
    rng: np.random.Generator,
) -> Pictures:
    """What a camera at this angle sees of a sphere's strands; `shape`: pixels, hits of each."""
    pixels, hits = shape
    towards = np.array([np.cos(angle), np.sin(angle), 0.0])
    size = int(np.ceil(np.sqrt(pixels)))
    camera = Camera.look_at(f"c{angle:.3f}", size, size, tuple(towards), (0, 0, 0), 12)
    turn, height = 2 * np.pi * roots[:, 0], 2 * roots[:, 1] - 1
    flat = np.sqrt(1 - height**2)
    normals = np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)
    facing = np.flatnonzero(normals @ towards > 0)
    strand = rng.choice(facing, (pixels, 1)).repeat(hits, axis=1)
    table = np.zeros((pixels, hits), RECORD)
    table["strand"], table["weight"] = strand, 1 / hits
    table["along"] = rng.uniform(size=(pixels, 1)) + rng.uniform(0, 0.02, (pixels, hits))
    table["along"] = table["along"].clip(0, 1)
    table["point"], table["normal"] = RADIUS * normals[strand], normals[strand]
    along = np.cross(normals, (0.3, 0.2, 0.9))
    table["tangent"] = (along / np.linalg.norm(along, axis=1, keepdims=True))[strand]
    index = np.arange(pixels)
    size_of = (len(lights), pixels, 3)
    halves = np.lib.format.open_memmap(
        folder / f"{camera.name}.npy", mode="w+", dtype=np.float32, shape=(2, *size_of)
    )
    captured = np.empty(size_of, np.float32)
    factor = 1 + 0.3 * np.sin(7 * roots[strand[:, 0], :1] + np.arange(3))
    for i in range(len(lights)):
        rendered = rng.uniform(0.05, 0.6, (pixels, 3))
        halves[:, i] = rendered * (1 + 0.03 * rng.normal(size=(2, pixels, 3)))
        captured[i] = rendered * factor * (1 + 0.03 * rng.normal(size=(pixels, 3)))
    halves.flush()
    return Pictures(
        Hits(camera, index, table), lights, halves, captured, np.ones(size_of[:2], bool)
    )

"""The fields' solver: its error against CPU time beside Adam's, and what a fit of a size costs."""

from __future__ import annotations

import resource
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from appearance.fields.anchors import Grid, Places, nested
from appearance.fields.basis import ViewBasis
from appearance.fields.fit import Monitor, fit_pictures
from appearance.fields.form import Form
from appearance.fields.grams import Gram
from appearance.fields.hits import RECORD, Hits
from appearance.fields.options import FieldOptions, FieldRequest
from appearance.fields.pictures import Pictures
from appearance.fields.pipeline import memory_needed
from appearance.fields.solver import AdamOptions, LeastSquares, Seen, adam, conjugate_gradients
from reconstruction import Camera, Light, Progress
from reconstruction.arrays import Array, Floats
from reconstruction.geometry.lights import dome_positions

Curve = list[dict[str, float]]
RATES = (0.003, 0.01, 0.03)
STRANDS = 10_000
RADIUS = 0.1


def curves(
    views: Sequence[Pictures], places: Places, scale: float, *, quick: bool = False
) -> dict[str, Curve]:
    """Objective above its minimum, as a share of that of no field, against CPU seconds."""
    options = FieldOptions("modulation")
    grids = [Grid.of(level, len(places.fitted)) for level in options.grids]
    samples = [p.samples(options, scale) for p in views]
    begun = time.process_time()
    grams = [Gram.of(s, options.degree) for s in samples]
    reducing = time.process_time() - begun
    seen = [
        Seen(ViewBasis.of(p.hits, grids[-1], places, options.degree, in_strands=True), [g])
        for p, g in zip(views, grams, strict=True)
    ]
    system = LeastSquares(seen, nested(grids, places), Form.of(options), 0.03)
    least = system.objective(conjugate_gradients(system, 12 if quick else 80, 1e-6))
    start = system.objective(np.zeros(system.shape, np.float32))
    found: dict[str, Curve] = {}

    def watch(name: str, every: int, offset: float) -> Any:
        curve = found.setdefault(name, [])
        clock = [time.process_time() - offset]

        def note(done: int, x: Floats, _: float) -> None:
            if done % every == 0:
                now = time.process_time()
                above = (system.objective(x) - least) / (start - least)
                curve.append({"cpu_seconds": now - clock[0], "above": float(above)})
                clock[0] += time.process_time() - now

        return note

    conjugate_gradients(system, 24, 1e-6, None, watch("conjugate gradients", 1, reducing))
    steps = 30 if quick else 600
    for rate in RATES:
        note = watch(f"Adam, rate {rate:g}", max(1, steps // 6), 0.0)
        adam(system, samples, AdamOptions(rate, steps), note)
    return found


def ratio(found: dict[str, Curve]) -> dict[str, float]:
    """The best error that Adam reached, its CPU seconds, and those of conjugate gradients to it."""
    ours = found["conjugate gradients"]
    best = min((p for n, c in found.items() if n.startswith("Adam") for p in c), key=_above)
    there = [p["cpu_seconds"] for p in ours if p["above"] <= best["above"]]
    out = {"above": best["above"], "adam_cpu_seconds": best["cpu_seconds"]}
    return out | ({"cpu_seconds": there[0]} if there else {})


def _above(point: dict[str, float]) -> float:
    return point["above"]


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

    def told(what: str, share: float) -> None:
        name = "validation" if what.startswith("ridge") else what.split(": ")[-1]
        if not marks or marks[-1][0] != name:
            marks.append((name, time.process_time()))
        progress(what, share)

    begun, before = time.process_time(), _peak()
    found = fit_pictures(views, Places.of(roots), 1.0, request.fit, Monitor(told))
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
        "gain": found.gain,
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

"""Single lights from frames under patterns, by least squares."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from reconstruction.arrays import Array, Bools, Floats
from reconstruction.capture.derived import copy_frame, derived
from reconstruction.capture.folder import Capture
from reconstruction.capture.light_patterns import ILL_CONDITIONED, Demultiplexing
from reconstruction.capture.records import CaptureError, Step
from reconstruction.capture.writer import CaptureWriter
from reconstruction.report.report import Progress, silent

MEMORY = 1 << 30
"""Bytes of the images of single lights that are summed at once."""
_FRAMES = 8
_SAMPLES = 20_000
"""Pixels of a camera by which the noise of frames is estimated."""
_TURNS, _LEAST = 5, 0.01
"""Rounds of that estimate, and its least variance over the median."""
_NONE = 1e-9
"""Coefficient below which a frame does not contribute."""


@dataclass(frozen=True, eq=False)
class Demultiplexed:
    """The `capture` of single lights, and notes for the user. `misfit` is the relative difference
    of frames from the sums of the lights, root mean square; None for as many patterns as lights."""

    capture: Capture
    solution: Demultiplexing
    misfit: float | None
    notes: tuple[str, ...]


def determines_lights(capture: Capture) -> bool:
    """Whether it has patterns, no single lights, and these follow from those with little error."""
    if capture.patterns is None or capture.olat_lights():
        return False
    return Demultiplexing(capture.patterns.rows(capture.lightings())).condition <= ILL_CONDITIONED


def demultiplex(source: Capture, out: Path, progress: Progress = silent) -> Demultiplexed:
    """Write the capture `out`, a new or empty folder, with `source`'s patterns as single lights.

    With more patterns than lights, each frame weighs by its noise, estimated from residuals. Pixels
    that are saturated under a pattern are in every light that it contributes to; other frames are
    copied. Raises `CaptureError` without patterns, where they do not determine the lights, or where
    all pixels of a camera are saturated.
    """
    patterns = source.patterns
    if patterns is None:
        raise CaptureError(f"{source.path}: the capture has no frames under patterns of lights")
    names, lights = source.lightings(), list(patterns.lights)
    whole = Demultiplexing(patterns.rows(names))
    if source.olat_lights():
        raise CaptureError(f"{source.path}: the capture has single lights already")
    if not whole.spans:
        raise CaptureError(
            f"{source.path}: {len(names)} patterns do not determine {len(lights)} lights: "
            "'hairstage reconstruct' and 'hairstage fit' take the patterns as they are"
        )
    shot = source.of_kind("pattern")
    others = [s for s in source.steps if s.kind != "pattern"]
    seconds, first = max(s.exposure for s in shot), 1 + max(s.index for s in source.steps)
    steps = {x: Step(first + i, "olat", seconds, light=x) for i, x in enumerate(lights)}
    record = {
        "condition": whole.condition,
        "read_noise_gain": dict(zip(lights, whole.read_gain.tolist(), strict=True)),
        "photon_noise_gain": dict(zip(lights, whole.photon_gain.tolist(), strict=True)),
    }
    plan = {k: v for k, v in source.plan.items() if k != "patterns"}
    plan |= {"steps": [*others, *steps.values()], "demultiplexed": record}
    cameras = [c.name for c in source.rig.cameras]
    misfits, notes = [], list(whole.warnings())
    with derived(source, out, source.rig, plan, "demultiplexed_from") as writer:
        for k, camera in enumerate(cameras):
            progress("demultiplexing", k / len(cameras))
            for step in others:
                copy_frame(source, step, camera, writer)
            there = [n for n in names if source.has_light(n, camera)]
            solution = Demultiplexing(patterns.rows(there))
            if not there or not solution.spans:
                missing = f"{len(names) - len(there)} of {len(names)} patterns have no frame"
                notes.append(f"{camera}: {missing}, the others do not determine the lights")
                for step in steps.values():
                    writer.record_missing(step, camera, reason=missing)
                continue
            if len(there) > len(lights):
                solution, misfit = _weighted(source, camera, there, solution)
                misfits.append(misfit)
            _write(source, camera, there, solution.matrix, steps, writer)
    off = float(np.sqrt(np.mean(np.square(misfits)))) if misfits else None
    return Demultiplexed(Capture(out), whole, off, tuple(notes))


def _weighted(
    source: Capture, camera: str, names: list[str], solution: Demultiplexing
) -> tuple[Demultiplexing, float]:
    """The solution weighted by the frames' noise, and their relative misfit."""
    values: list[Array] = []
    known: Bools | None = None
    for name in names:
        image, saturated = source.light(name, camera)
        step = max(1, saturated.size // _SAMPLES)
        values.append(image.reshape(-1, 3)[::step].astype(float))
        usable = ~saturated.ravel()[::step]
        known = usable if known is None else known & usable
    if known is None or not known.any():
        raise CaptureError(
            f"{source.path}: every pixel of {camera} is saturated under a pattern: shoot them at a "
            "lower level or a shorter exposure"
        )
    frames, misfit = np.stack(values)[:, known], 0.0
    size = float(np.square(frames).mean()) or 1.0
    for turn in range(_TURNS):
        hat = solution.weights @ solution.matrix
        mean = np.square(frames - np.tensordot(hat, frames, 1)).mean(axis=(1, 2))
        misfit = misfit if turn else float(np.sqrt(mean.mean() / size))
        # a frame's mean square residual is its variance less its leverage
        variances = mean / np.maximum(1 - np.diag(hat), 1e-6)
        least = max(_LEAST * float(np.median(variances)), 1e-12 * size)
        solution = Demultiplexing(solution.weights, np.maximum(variances, least))
    return solution, misfit


def _write(
    source: Capture,
    camera: str,
    names: list[str],
    matrix: Array,
    steps: dict[str, Step],
    writer: CaptureWriter,
) -> None:
    """Write the lights `matrix (L, P)` times the frames called `names (P)`.

    Stray light is added again, as readers subtract it from each frame.
    """
    c, some = source.rig.camera(camera), list(steps.values())
    pixels = c.width * c.height
    at_once = max(1, MEMORY // (13 * pixels))
    for begin in range(0, len(some), at_once):
        rows = np.asarray(matrix[begin : begin + at_once], np.float32)
        total, full = (
            np.zeros((len(rows), 3 * pixels), np.float32),
            np.zeros((len(rows), pixels), bool),
        )
        for i in range(0, len(names), _FRAMES):
            part = names[i : i + _FRAMES]
            shots = [source.light(name, camera) for name in part]
            columns = rows[:, i : i + len(part)]
            total += columns @ np.stack([image.ravel() for image, _ in shots])
            for (_, saturated), column in zip(shots, columns.T, strict=True):
                full[np.abs(column) > _NONE] |= saturated.ravel()
        for row, clipped, step in zip(total, full, some[begin:], strict=False):
            image: Floats = row.reshape(c.height, c.width, 3)
            stray = source.stray_light_of(camera, step.exposure)
            image = image if stray is None else image + stray
            scale = 1.001 * float(image.max(initial=1e-12)) if clipped.any() else np.inf
            image[clipped.reshape(c.height, c.width)] = scale if clipped.any() else 0.0
            writer.write_frame(step, camera, image, full_scale=scale)

"""Single lights of a subject that moves, stabilised by the lit frames among them, and still.

A small stage shades each step in the pose of its time: a drift by so many millimetres and degrees
over the capture, or a jump. Errors of the motion; of a single light's picture beside that of the
still subject; of a left-out light by the three nearest ones; with `--strands`, of strands. Leaves
`motion.json` and `motion.md`.
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from appearance.model.baselines import three_nearest
from benchmarks.command import SUBJECT, Benchmark, option
from benchmarks.results import markdown, save, spread
from benchmarks.strand_truth import StrandTruth, write_hair_masks
from benchmarks.subjects import Subject, simulated
from reconstruction import (
    Camera,
    Capture,
    CaptureWriter,
    Light,
    Model,
    Progress,
    ReconstructOptions,
    Rig,
    Step,
    reconstruct,
    write_strands,
)
from reconstruction.arrays import Array, Bools, Floats, Ints
from reconstruction.geometry.lights import dome_positions
from reconstruction.light_planes.stabilising import stabilise

SEEDS = option("--seeds", "how many subjects, from --seed on", type=int, default=2)
STRANDS = option("--strands", "score strands too: 3 CPU minutes a capture", action="store_true")
DRIFTS = {"2 mm, 1°": (2e-3, 1.0), "5 mm, 2°": (5e-3, 2.0), "10 mm, 3°": (10e-3, 3.0)}
JUMP = (5e-3, 2.0)
STRIDE = 4
"""Of the strands' points."""
Points = tuple[Array, Array, Ints]
"""Points `(N, 3)` of strands, their tangents, and the numbers of their strands."""
Poses = Callable[[float], tuple[Array, Array]]


@dataclass(frozen=True)
class Size:
    """Pixels across, cameras, lights, single lights from a lit frame to the next; of `DRIFTS`."""

    pixels: int = 160
    cameras: int = 4
    lights: int = 32
    every: int = 8
    drifts: tuple[str, ...] = tuple(DRIFTS)


def drift(shift: float, turn_deg: float, seed: int, jump_at: float | None = None) -> Poses:
    """The pose at a share 0 to 1 of the capture: smooth, or at once at `jump_at`."""
    rng = np.random.default_rng([seed, 11])
    axis, way = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    bend = rng.normal(size=3) * 0.25

    def pose(time: float) -> tuple[Array, Array]:
        far = float(time >= jump_at) if jump_at is not None else time
        curve = 0.0 if jump_at is not None else float(np.sin(2 * np.pi * time))
        turn = Rotation.from_rotvec(np.radians(turn_deg) * (far * axis + 0.5 * curve * bend))
        return turn.as_matrix(), shift * (far * way + curve * bend)

    return pose


def stage(size: Size, subject: Subject) -> Rig:
    """Cameras around the subject's middle, and a dome of lights."""
    low, high = (f(subject.strands.points, axis=0).astype(float) for f in (np.min, np.max))
    middle, reach = 0.5 * (low + high), 0.62 * float((high - low).max())
    cameras = [
        Camera.look_at(
            f"cam_{k:02d}", size.pixels, size.pixels, place + middle, middle,
            float(np.degrees(2 * np.arctan(reach / 0.95))),
        )
        for k, place in enumerate(dome_positions(size.cameras, 0.95, 0.0))
    ]  # fmt: skip
    places = dome_positions(size.lights, 1.2, lowest_deg=-30)
    order = np.random.default_rng(0).permutation(size.lights)  # neighbours at other times
    lights = [Light(f"light_{k:02d}", places[i], np.full(3, 8.0)) for k, i in enumerate(order)]
    return Rig("moving", tuple(cameras), tuple(lights))


def plan(size: Size) -> list[Step]:
    """A lit frame before every `every` single lights, and at the end."""
    kinds: list[dict[str, Any]] = []
    for k in range(size.lights):
        kinds += [{"kind": "all_on"}] * (k % size.every == 0)
        kinds.append({"kind": "olat", "light": f"light_{k:02d}"})
    kinds.append({"kind": "all_on"})
    return [Step(i, exposure=0.02, **k) for i, k in enumerate(kinds)]


def shaded(hair: Points, camera: Camera, lights: list[Light]) -> Floats:
    """The sum of images `(H, W, 3)` under `lights` by Kajiya and Kay (1989), without shadows.

    Points of strands within 4 mm behind the first one in a pixel share it: no noise, which would
    hide a motion below a pixel.
    """
    points, tangents, owner = hair
    visible, x, y, depth = camera.pixels_of(points)
    first = np.full((camera.height, camera.width), np.inf)
    np.minimum.at(first, (y[visible], x[visible]), depth[visible])
    visible &= depth < first[y, x] + 4e-3
    p, t, dyed = points[visible], tangents[visible], owner[visible] * 0.618 % 1
    out = p - np.median(points, axis=0)
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    to_camera = camera.center - p
    to_camera /= np.linalg.norm(to_camera, axis=1, keepdims=True)
    sin_r = (t * to_camera).sum(axis=1)
    value = np.zeros(len(p))
    for light in lights:
        to = light.position - p
        square = (to**2).sum(axis=1)
        to /= np.sqrt(square)[:, None]
        sin_i, facing = (t * to).sum(axis=1), np.maximum((out * to).sum(axis=1) + 0.2, 0)
        lobe = np.exp(-(((np.arcsin(sin_i) + np.arcsin(sin_r)) / 0.15) ** 2))
        value += light.intensity[0] / square * facing * (
            0.1 * (0.4 + dyed) * np.sqrt(1 - sin_i**2) + 0.3 * lobe
        )  # fmt: skip
    pixels, _ = camera.project(p)
    whole = np.floor(pixels).astype(int)
    sums = np.zeros((2, camera.height, camera.width))
    for dx, dy in np.ndindex(2, 2):  # bilinear: a shift by part of a pixel changes the image
        near = whole + np.array([dx, dy])
        share = np.prod(1 - np.abs(pixels - near), axis=1)
        inside = camera.inside(near)
        place = near[inside, 1], near[inside, 0]
        np.add.at(sums[0], place, (share * value)[inside])
        np.add.at(sums[1], place, share[inside])
    value_sum, count = (cv2.GaussianBlur(x, (0, 0), 0.7) for x in sums)
    mean = (value_sum / (count + 0.2)).astype(np.float32)
    return np.repeat(mean[..., None], 3, axis=2)


def shoot(path: Path, subject: Subject, size: Size, pose: Poses) -> Capture:
    """Render the capture `path`: the stage moves the other way around the still subject."""
    shutil.rmtree(path, ignore_errors=True)
    rig, steps = stage(size, subject), plan(size)
    writer = CaptureWriter.create(path, rig, {"steps": steps}, head=subject.head)
    strands, records = subject.strands, []
    hair = (
        strands.points[::STRIDE].astype(float),
        strands.tangents()[::STRIDE].astype(float),
        strands.strand_of_point[::STRIDE],
    )
    for step in steps:
        turn, shift = pose(step.index / (len(steps) - 1))
        lights = [x.moved(turn, shift) for x in rig.lights if step.light in (None, x.name)]
        lights = lights[:: size.every // 2] if step.light is None else lights
        for camera in rig.cameras:
            image = shaded(hair, camera.moved(turn, shift), lights)
            records.append(writer.store_frame(step, camera.name, image))
    writer.commit(records)
    writer.finish("completed")
    return Capture(path)


def motion_errors(found: Any, pose: Poses, steps: list[Step], points: Array) -> dict[str, float]:
    """Root mean square errors at `points (N, 3)` and of turns, over all single lights."""
    singles = [s.index for s in steps if s.light is not None]
    metres, turns = [], []
    for k, turn, shift in zip(singles, *found.at(singles), strict=True):
        R, t = pose(k / (len(steps) - 1))
        metres.append(((points @ (turn - R).T + shift - t) ** 2).sum(axis=1).mean())
        turns.append(np.linalg.norm(Rotation.from_matrix(turn @ R.T).as_rotvec()))
    mm, deg = 1e3 * np.sqrt(np.mean(metres)), np.degrees(np.sqrt(np.mean(np.square(turns))))
    return {"motion mm": float(mm), "motion °": float(deg)}


def picture_errors(capture: Capture, still: Capture, hair: dict[str, Bools]) -> dict[str, float]:
    """Relative errors, root mean square over the hair, of frames and of left-out lights by their
    three nearest ones, beside the frames of the still subject."""
    lights = capture.olat_lights()
    off, left, size = np.zeros(3)
    for camera, mask in hair.items():
        for name in lights[1::4]:
            true = still.light(name, camera)[0][mask].astype(float)
            guess = three_nearest(capture, camera, still.rig.light(name), lights)[mask]
            off += float(np.square(capture.light(name, camera)[0][mask] - true).sum())
            left += float(np.square(guess - true).sum())
            size += float(np.square(true).sum())
    return {"pictures": (off / size) ** 0.5, "left-out light": (left / size) ** 0.5}


def strand_errors(capture: Capture, truth: StrandTruth, model: Path, seed: int) -> dict[str, float]:
    """F within 2 mm and 20°."""
    shutil.rmtree(model, ignore_errors=True)
    reconstruct(capture, Model(model), options=ReconstructOptions(seed=seed))
    return {"F": truth.score(Model(model).strands())["visible"]["2mm_20deg"]["f"]}


def measure(
    out: Path, subject: Subject, size: Size, seed: int, strands: bool, progress: Progress
) -> dict[str, Any]:
    """Each motion's errors as shot and stabilised, and those of the still subject.

    F too, if `strands`.
    """
    (out / "truth").mkdir(parents=True, exist_ok=True)
    write_strands(out / "truth" / "strands.npz", subject.strands)
    singles = [s for s in plan(size) if s.light is not None]
    # in the middle of the lit frames around the middle of the capture
    at = (singles[len(singles) // 2 + size.every // 4].index - 0.5) / (len(plan(size)) - 1)
    cases = {"still": drift(0.0, 0.0, seed)}
    cases |= {name: drift(*DRIFTS[name], seed) for name in size.drifts}
    cases[f"jump {JUMP[0] * 1e3:g} mm, {JUMP[1]:g}°"] = drift(*JUMP, seed, at)
    points = subject.strands.points[::50].astype(float)
    found: dict[str, Any] = {}
    hair: dict[str, Bools] = {}
    for k, (name, pose) in enumerate(cases.items()):
        progress(name, k / len(cases))
        capture = shoot(out / "captures" / str(k), subject, size, pose)
        if name == "still":
            still = capture
            write_hair_masks(capture, out / "truth")
            for camera in capture.rig.cameras:
                hair[camera.name] = np.asarray(capture.mask(camera.name))
            truth = StrandTruth(still, out / "truth", samples=10_000) if strands else None
            found["still"] = picture_errors(still, still, hair)
            if truth is not None:
                found["still"] |= strand_errors(still, truth, out / "model", seed)
            save(out / f"{seed}.json", found)
            continue
        shutil.rmtree(out / "captures" / "stabilised", ignore_errors=True)
        result = stabilise(capture, out / "captures" / "stabilised")
        none = motion_errors(type(result.motion).none(), pose, plan(size), points)
        rows = {
            f"{name}, as shot": (capture, none),
            f"{name}, stabilised": (
                result.capture,
                motion_errors(result.motion, pose, plan(size), points) | result.figures,
            ),
        }
        for row, (one, errors) in rows.items():
            found[row] = {**errors, **picture_errors(one, still, hair)}
            if truth is not None:
                found[row] |= strand_errors(one, truth, out / "model", seed)
            save(out / f"{seed}.json", found)
    return found


LIT = ("lit_difference_as_shot", "lit_difference_stabilised")
COLUMNS = ("motion mm", "motion °", "error_mm", *LIT, "pictures", "left-out light", "F")


def _bench(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    size = Size(64, 4, 12, 4, ("5 mm, 2°",)) if args.quick else Size()
    seeds: list[dict[str, Any]] = []
    for seed in range(args.seed, args.seed + (1 if args.quick else args.seeds)):
        subject = simulated(args.rig, args.subject, args.head, seed)
        seeds.append(measure(args.out / "motion", subject, size, seed, args.strands, progress))
        found = {
            row: {c: spread([s[row][c] for s in seeds]) for c in COLUMNS if c in seeds[0][row]}
            for row in seeds[0]
        }
        save(args.out / "motion.json", {"mean": found, "seeds": seeds})
    rows = [
        [row, *[f"{x[c]['mean']:.3f}" if c in x else "" for c in COLUMNS]]
        for row, x in found.items()
    ]
    (args.out / "motion.md").write_text(markdown(["capture", *COLUMNS], rows))
    return {"mean": found, "seeds": seeds}


BENCHMARK = Benchmark(_bench, (*SUBJECT, SEEDS, STRANDS))

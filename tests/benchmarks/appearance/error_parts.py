"""What the error of a reconstructed model is made of: its parts replaced by the truth.

Ours and true strands are cut into pieces of a pixel's length and matched one to one. `PARTS` are
replaced alone, in turn, and all but one. Leaves `error_parts.json` and `error_parts.md`.
"""

from __future__ import annotations

import argparse
import subprocess
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from appearance import HairScene, build_scene
from appearance.bsdf.maps import HairMaps, MappedStrands
from appearance.metrics.scores import srgb
from appearance.model.fitted_model import FittedModel
from appearance.render.smoothed import olat_smoothed
from appearance.render.tracing import Sampling
from benchmarks.command import CACHE, Benchmark, LeftOut, option
from benchmarks.results import markdown, save
from benchmarks.subjects import Subject, true_subject
from reconstruction import Camera, Capture, Model, Progress, Strands
from reconstruction.arrays import AnyFloats, Array, Bools, Floats, Ints
from reconstruction.capture_scale import pixel_size
from reconstruction.reading import read_json
from stage_service.cli.support.children import own_command

PARTS = ("shading", "direction", "place", "surplus", "missing", "thickness")
"""In the order in which they are replaced: material, skin and lights; directions and places of
matched pieces; pieces without a true one; true pieces without one of ours; radii."""
GROUPS = ("held-out lights", "held-out camera")
NEAR = 2.0
"""Greatest distance of a matched pair: pixels, and per 30° of direction one more."""
MOST_PIECES = 800_000
"""In a scene: the float32 index of a segment on Mitsuba's curves is inexact above about 2^20."""
_ROUNDS = 12


@dataclass(frozen=True, eq=False)
class Pieces:
    """Straight pieces of strands, metres: `middle`, `vector`, `absorption (N, 3)`, `radius (N,)`"""

    middle: Array
    vector: Array
    absorption: Array
    radius: Array

    @classmethod
    def of(cls, strands: Strands, maps: HairMaps, root_uv: Array, length: float) -> Pieces:
        """`strands` in pieces of about `length`, their absorption that of `maps`."""
        cut = strands.resampled(length)
        starts = cut.segment_starts
        a, b = (cut.points[starts + k].astype(float) for k in (0, 1))
        owner = cut.strand_of_point[starts]
        count = np.diff(cut.offsets) - 1
        along = (starts - cut.offsets[owner] + 0.5) / count[owner]
        layers, columns, rows = maps.shape
        u, v = np.minimum(root_uv[owner] * (columns, rows), (columns - 1, rows - 1)).astype(int).T
        low = np.minimum((along * (layers - 1)).astype(int), max(layers - 2, 0))
        share = (along * (layers - 1) - low)[:, None]
        high = np.minimum(low + 1, layers - 1)
        sigma = maps.sigma_a[low, u, v] * (1 - share) + maps.sigma_a[high, u, v] * share
        radius = np.broadcast_to(np.asarray(cut.radius, float), len(cut.points))[starts]
        return cls(0.5 * (a + b), b - a, sigma, radius)

    def at(self, which: Ints | Bools) -> Pieces:
        """Some of them."""
        arrays = (self.middle, self.vector, self.absorption, self.radius)
        return Pieces(*(x[which] for x in arrays))

    def places(self, pixel: float) -> Array:
        """Coordinates `(N, 6)` in which pairs are near: pixels, and 30° of direction are one."""
        direction = self.vector / np.linalg.norm(self.vector, axis=1, keepdims=True)
        return np.hstack([self.middle / pixel, direction / np.radians(30)])

    def scene(self, maps: HairMaps, of: Subject) -> HairScene:
        """With roughness and index of `maps`, on the head of a subject with its skin."""
        ends = np.stack([self.middle - self.vector / 2, self.middle + self.vector / 2], axis=1)
        offsets = 2 * np.arange(len(ends) + 1)
        radius = np.repeat(self.radius, 2).astype(np.float32)
        strands = Strands(ends.reshape(-1, 3).astype(np.float32), offsets, radius)
        red, green, blue = (float(x) for x in self.absorption.mean(axis=0))
        hair = replace(maps.mean(), sigma_a=(red, green, blue))
        scene = build_scene(strands, of.head, hair=hair, skin=of.skin)
        if (self.absorption == self.absorption[0]).all():
            return scene
        each = HairMaps.each(hair, self.absorption[None])
        return MappedStrands.alone(scene, strands).with_maps(each)


def joined(parts: Sequence[Pieces]) -> Pieces:
    """All of them."""
    names = ("middle", "vector", "absorption", "radius")
    return Pieces(*(np.concatenate([getattr(p, n) for p in parts]) for n in names))


def matched(ours: Array, true: Array, near: float) -> tuple[Ints, Ints]:
    """One-to-one pairs `(M,)` of points `(N, 6)` at most `near` apart, nearest first.

    In rounds: each free one of ours proposes to the nearest free true one, which takes the nearest.
    """
    free, left = np.arange(len(ours)), np.arange(len(true))
    pairs: list[tuple[Ints, Ints]] = []
    for _ in range(_ROUNDS):
        if not len(free) or not len(left):
            break
        distance, at = cKDTree(true[left]).query(ours[free], distance_upper_bound=near, workers=-1)
        there = np.flatnonzero(np.isfinite(distance))
        if not len(there):
            break
        order = there[np.argsort(distance[there], kind="stable")]
        taken, first = np.unique(at[order], return_index=True)
        pairs.append((free[order[first]], left[taken]))
        free = np.setdiff1d(free[there], pairs[-1][0])  # others are near nothing that is left
        left = np.delete(left, taken)
    none = np.zeros(0, np.int64)
    return (
        np.concatenate([none, *(p[0] for p in pairs)]),
        np.concatenate([none, *(p[1] for p in pairs)]),
    )


class Mixture:
    """Pieces of ours and of the truth, matched; scenes with some parts replaced by the truth."""

    def __init__(self, ours: Pieces, true: Pieces, pixel: float) -> None:
        a, b = matched(ours.places(pixel), true.places(pixel), NEAR)
        surplus, missing = (
            np.setdiff1d(np.arange(len(x.radius)), used) for x, used in ((ours, a), (true, b))
        )
        self.pair = ours.at(a), true.at(b)
        # what has no counterpart has the material and the radius of the nearest of the others
        self.surplus = self._twice(ours.at(surplus), true)
        missed = self._twice(true.at(missing), ours)
        self.missing = missed[1], missed[0]
        away = np.linalg.norm(self.pair[0].middle - self.pair[1].middle, axis=1)
        turn = _degrees(self.pair[0].vector, self.pair[1].vector)
        length = [float(np.linalg.norm(x.vector, axis=1).sum()) for x in (ours, true)]
        self.figures = {
            "pixel_mm": 1e3 * pixel,
            "ours_m": length[0],
            "true_m": length[1],
            "matched_share_of_truth": len(b) / max(len(true.radius), 1),
            "surplus_share_of_ours": len(surplus) / max(len(ours.radius), 1),
            "radius_um": [1e6 * float(x.radius.mean()) for x in (ours, true)],
            "median_distance_mm": 1e3 * float(np.median(away)) if len(away) else None,
            "median_angle_deg": float(np.median(turn)) if len(turn) else None,
        }

    @staticmethod
    def _twice(pieces: Pieces, others: Pieces) -> tuple[Pieces, Pieces]:
        near = cKDTree(others.middle).query(pieces.middle, workers=-1)[1]
        other = others.at(near)
        return pieces, replace(pieces, absorption=other.absorption, radius=other.radius)

    def pieces(self, replaced: Collection[str]) -> Pieces:
        """With `replaced` of `PARTS` as in the truth."""
        names = {"shading": "absorption", "direction": "vector", "place": "middle"}
        names["thickness"] = "radius"
        groups = [self.pair]
        groups += [] if "surplus" in replaced else [self.surplus]
        groups += [self.missing] if "missing" in replaced else []
        out = []
        for ours, true in groups:
            better = {n: getattr(true, n) for part, n in names.items() if part in replaced}
            out.append(replace(ours, **better))
        return joined(out)


def _degrees(one: Array, other: Array) -> Array:
    cosine = (one * other).sum(axis=1)
    cosine /= np.maximum(np.linalg.norm(one, axis=1) * np.linalg.norm(other, axis=1), 1e-12)
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


@dataclass(frozen=True, eq=False)
class Judged:
    """A camera's frames of a group at hair `pixels (P,)`: `captured (L, P, 3)`, `valid (L, P)`."""

    group: str
    camera: Camera
    lights: tuple[str, ...]
    pixels: Ints
    captured: Floats
    valid: Bools


class ErrorParts:
    """The table of one demo."""

    def __init__(self, demo: Path, sizes: tuple[int, int, int], progress: Progress) -> None:
        cameras, lights, self.spp = sizes
        self.progress = progress
        self.capture, self.model = Capture(demo / "capture"), Model(demo / "model")
        self.fitted = FittedModel.load(self.model, self.capture)
        self.truth = true_subject(demo / "truth")
        held = read_json(demo / "results.json")["held_out"]
        self.scale = self.fitted.appearance.exposure.scale
        train = [c.name for c in self.capture.rig.cameras if c.name not in held["held_out_cameras"]]
        few = _spread(held["held_out_lights"], lights)
        groups = [(GROUPS[0], name) for name in _spread(train, cameras)]
        groups += [(GROUPS[1], name) for name in held["held_out_cameras"]]
        self.judged = [self._judged(group, name, few) for group, name in groups]
        points = self.truth.strands.points.mean(axis=0, dtype=float)
        self.pixel = pixel_size(self.capture.rig.cameras, points)

    def _judged(self, group: str, name: str, lights: Sequence[str]) -> Judged:
        pixels = np.flatnonzero(self.model.mask(name, "hair", self.capture))
        found = [self.capture.light(n, name) for n in lights]
        captured = np.stack([image.reshape(-1, 3)[pixels] for image, _ in found])
        valid = np.stack([~saturated.ravel()[pixels] for _, saturated in found])
        camera = self.capture.rig.camera(name)
        return Judged(group, camera, tuple(lights), pixels, captured, valid)

    def run(self) -> dict[str, Any]:
        """The figures; see `report`."""
        fitted, truth = self.fitted, self.truth
        self.progress("rendering the truth", 0.0)
        self.true = self._halves(truth.scene(), False, 2)
        fit = replace(truth, head=fitted.head, skin=fitted.appearance.skin)
        longest = max(float(x.strands.lengths().sum()) for x in (fitted, truth))
        length = max(self.pixel, longest / MOST_PIECES)
        of_truth = HairMaps.of(truth.hair)
        if truth.absorption is not None:
            of_truth = HairMaps.each(truth.hair, truth.absorption)
        self.progress("matching pieces of strands", 0.05)
        alone = (np.arange(len(truth.strands)) + 0.5) / len(truth.strands)
        mixture = Mixture(
            Pieces.of(fitted.strands, fitted.maps, fitted.root_uv, length),
            Pieces.of(truth.strands, of_truth, np.stack([alone, 0 * alone], axis=-1), length),
            self.pixel,
        )
        captured = self._psnr([(j.captured, j.captured) for j in self.judged])
        done: dict[frozenset[str], list[float]] = {}
        ours = self._halves(fitted.scene(), True)
        rows: dict[str, Any] = {
            "ours against captured frames": self._psnr(ours, captured=True),
            "captured frames": captured,
            "ours": self._psnr(ours),
        }
        if fitted.field is not None:
            rows["ours without its field"] = self._psnr(
                self._halves(fitted.without_field().scene(), True)
            )
        wanted = [PARTS[:k] for k in range(len(PARTS) + 1)]
        wanted += [(p,) for p in PARTS] + [tuple(q for q in PARTS if q != p) for p in PARTS]
        for k, parts in enumerate(wanted):
            key = frozenset(parts)
            if key in done:
                continue
            self.progress(f"true {', '.join(parts) or 'nothing'}", 0.1 + 0.9 * k / len(wanted))
            shaded = "shading" in key
            material = (of_truth, truth) if shaded else (fitted.maps, fit)
            done[key] = self._psnr(self._halves(mixture.pieces(key).scene(*material), not shaded))
        return {
            "groups": GROUPS,
            "cameras": [(j.group, j.camera.name, list(j.lights)) for j in self.judged],
            "matching": mixture.figures,
            "whole": rows,
            "in_pieces": done[frozenset()],
            "alone": {p: done[frozenset([p])] for p in PARTS},
            "in_turn": {p: done[frozenset(PARTS[: k + 1])] for k, p in enumerate(PARTS)},
            "alone_wrong": {p: done[frozenset(PARTS) - {p}] for p in PARTS},
        }

    def _halves(self, scene: HairScene, fitted: bool, more: int = 1) -> list[tuple[Array, Array]]:
        """Two independent images `(L, P, 3)` of each judged camera, lights as fitted or true."""
        out = []
        for j in self.judged:
            lights = [self.capture.rig.light(n) for n in j.lights]
            if fitted:
                lights = self.fitted.lights(j.lights)
            one, other = (
                olat_smoothed(
                    scene,
                    j.camera,
                    lights,
                    Sampling(more * self.spp, 16, 1000 * more + h),
                    pixels=j.pixels,
                ).astype(float)
                for h in (0, 1)
            )
            out.append((one, other))
        return out

    def _psnr(
        self, images: Sequence[tuple[AnyFloats, AnyFloats]], captured: bool = False
    ) -> list[float]:
        """PSNR of displayed values in each group: without noise against the truth, or against the
        captured frames."""
        squares, counts = np.zeros((2, len(GROUPS)))
        pair: Sequence[AnyFloats]
        for j, pair, true in zip(self.judged, images, self.true, strict=True):
            g = GROUPS.index(j.group)
            targets: tuple[AnyFloats, AnyFloats] = true
            if captured:
                pair, targets = [0.5 * (pair[0] + pair[1])] * 2, (j.captured, j.captured)
            a, b = (
                srgb(x * self.scale) - srgb(t * self.scale)
                for x, t in zip(pair, targets, strict=True)
            )
            squares[g] += (a * b)[j.valid].sum()
            counts[g] += 3 * j.valid.sum()
        return [float(x) for x in -10 * np.log10(np.maximum(squares / counts, 1e-6))]


def _spread(items: Sequence[str], most: int) -> list[str]:
    count = min(most, len(items))
    return [items[int((k + 0.5) * len(items) / count)] for k in range(count)]


def report(found: dict[str, Any]) -> str:
    """The table: dB gained where a part alone is true, PSNR as they are replaced in turn, and
    PSNR of the truth with this part alone as ours."""
    start, before = found["in_pieces"], found["in_pieces"]
    lines = []
    for name, psnr in found["whole"].items():
        lines.append([name, *[x for value in psnr for x in ("", f"{value:.1f}", "")]])
    lines.append(["ours, in pieces", *[x for v in start for x in ("", f"{v:.1f}", "")]])
    for part in PARTS:
        alone, turn, wrong = (found[k][part] for k in ("alone", "in_turn", "alone_wrong"))
        cells = [
            x
            for g in range(len(GROUPS))
            for x in (
                f"{alone[g] - start[g]:+.1f}",
                f"{turn[g]:.1f} ({turn[g] - before[g]:+.1f})",
                f"{wrong[g]:.1f}",
            )
        ]
        lines.append([part, *cells])
        before = turn
    columns = ("alone", "in turn", "only it ours")
    head = ["part of the truth", *[f"{g}: {k}" for g in GROUPS for k in columns]]
    m = found["matching"]
    return markdown(head, lines) + (
        f"\n{m['matched_share_of_truth']:.0%} of {m['true_m']:.0f} m of true strands have a "
        f"counterpart, median {m['median_distance_mm']:.2f} mm and {m['median_angle_deg']:.0f}° "
        f"off; {m['surplus_share_of_ours']:.0%} of our {m['ours_m']:.0f} m have none. Radii "
        f"{m['radius_um'][0]:.0f} and {m['radius_um'][1]:.0f} µm; pixel {m['pixel_mm']:.2f} mm.\n"
    )


def _bench(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    demo = args.demo
    if demo is None:
        demo = args.cache / f"quick-demo-{args.seed}"
        if not (demo / "results.json").is_file():
            progress("making a quick demo", 0.0)
            command = own_command("demo", "--quick", "--seed", str(args.seed), "--out", str(demo))
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    if not (demo / "results.json").is_file():
        raise LeftOut(f"{demo}: not the folder of a demo that has ended: give it as --demo")
    found = ErrorParts(demo, (1, 2, 8) if args.quick else (2, 4, 32), progress).run()
    save(args.out / "error_parts.json", found)
    (args.out / "error_parts.md").write_text(text := report(found))
    progress(text, 1.0)
    return found


DEMO = option("--demo", "folder of a demo; without one a quick demo is made", type=Path)
BENCHMARK = Benchmark(_bench, (CACHE, DEMO))

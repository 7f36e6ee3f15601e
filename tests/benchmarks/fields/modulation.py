"""Fields of reflectance beside what they have to beat, and their solver beside Adam.

On the wavy groom with a truth finer than the fit, and inverse rendering emulated: strands bent by
5°, coarse colours, β_M 7 % and β_N 10 % off. Frames interpolated on the bent strands are judged on
the same pixels. Under environments, lights of the dome stand for the map about them; "brightest"
adds what an additive field has from the map's brightest direction alone, with all of its light.
Leaves `fields.json` and `fields.md`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from appearance import Exposure, build_scene
from appearance.bsdf.maps import MappedStrands, scalp_coordinates
from appearance.fields.anchors import Places
from appearance.fields.field import Field
from appearance.fields.fit import fit_pictures
from appearance.fields.hits import HitOptions, find_hits
from appearance.fields.interpolation import Interpolation
from appearance.fields.options import FieldOptions
from appearance.fields.pictures import Pictures
from appearance.fields.reflectance import CapturedView, ReflectanceField
from appearance.fields.search import searched
from appearance.fields.validation import GROUPS
from appearance.metrics.scores import srgb
from appearance.model.relight import environment_map
from appearance.render.coverage import coverage
from appearance.render.olat import render_olat, render_olat_parts
from appearance.render.smoothed import smoothed
from benchmarks.appearance.known_subjects import SmallStage, bent, dome, dyed, ring
from benchmarks.command import SUBJECT, Benchmark, option
from benchmarks.fields.solvers import cost, curves, ratio
from benchmarks.results import markdown, save, spread
from benchmarks.subjects import Subject, simulated
from reconstruction import Light, Progress, Strands, silent
from reconstruction.arrays import AnyFloats, Array, Floats

STAGE = SmallStage(size=24, cameras=8, lights=18, spp=144, max_depth=6, truth=(12, 48, 48))
COARSE = (4, 8, 8)
"""Cells of the emulated inverse rendering's colours."""
DIRECT = 8
"""Times as many paths for the light of the first hit, which no smoothing frees of noise."""
HELD_VIEWS = (0, 4)
MAPS = ("studio", "sky")
MAPPED, BRIGHTEST = "maps", "maps, brightest"
Pair = tuple[AnyFloats, AnyFloats]
FIELDS = {
    "GaussianHair's: dual harmonics of the whole picture, degree 3": FieldOptions(
        "whole", degree=3, iterations=12
    ),
    "additive (GroomLight's), degree 3": FieldOptions("additive", degree=3, iterations=12),
    "modulation, degree 0": FieldOptions(degree=0),
    "modulation, degree 1": FieldOptions(),
    "modulation, degree 2": FieldOptions(degree=2),
}
SIZES = {"full": STAGE, "quick": SmallStage(12, cameras=4, lights=8, spp=16, max_depth=3)}


@dataclass(frozen=True, eq=False)
class Frames:
    """A subject: `halves` of the truth's and of inverse rendering's pictures, views by number.

    Each is two independent pictures `(L, P, 3)`; `pictures` have the means, under all lights.
    `mapped` holds the bent `strands`.
    """

    pictures: tuple[Pictures, ...]
    true: tuple[tuple[Floats, Floats], ...]
    rendered: tuple[tuple[Floats, Floats], ...]
    places: Places
    scale: float
    held_views: tuple[int, ...]
    held_lights: tuple[int, ...]
    mapped: MappedStrands
    strands: Strands

    def training(self) -> list[Pictures]:
        """What a fit sees."""
        lights = len(self.pictures[0].lights)
        kept = [i for i in range(lights) if i not in self.held_lights]
        return [p.under(kept) for k, p in enumerate(self.pictures) if k not in self.held_views]

    def psnr(self, pictures: Mapping[int, Pair]) -> dict[str, float]:
        """PSNR without noise by group of `GROUPS`: products of errors of independent halves.

        With `MAPPED`, that of held-out views under environments, where all of them are given.
        """
        found: dict[str, list[Array]] = {g: [] for g in GROUPS}
        for k, (one, other) in pictures.items():
            a, b = (
                srgb(x * self.scale) - srgb(t * self.scale)
                for x, t in zip((one, other), self.true[k], strict=True)
            )
            product = (a * b).mean(axis=2)
            new = np.isin(np.arange(len(product)), self.held_lights)
            if k in self.held_views:
                found[GROUPS[1]].append(product[~new].ravel())
                found[GROUPS[2]].append(product[new].ravel())
            else:
                found[GROUPS[0]].append(product[new].ravel())
        out = {
            g: float(-10 * np.log10(max(float(np.concatenate(v).mean()), 1e-6)))
            for g, v in found.items()
            if v
        }
        if set(self.held_views) <= set(pictures):
            out[MAPPED] = under_maps(self, lambda k, weights: summed(pictures[k], weights))
        return out


def frames_of(subject: Subject, rig: SmallStage, seed: int) -> Frames:
    """The wavy groom dyed finely, captured; and as inverse rendering would have it."""
    strands, head = subject.strands, subject.head
    uv = scalp_coordinates(strands, head)
    scene = subject.scene()
    truth = dyed(subject.hair, seed, rig.truth)
    shown = MappedStrands.of(scene, strands, uv).with_maps(truth)
    noisy = bent(strands, uv, 5.0, seed)
    base = build_scene(noisy, head, hair=subject.hair, skin=subject.skin)
    mapped = MappedStrands.of(base, noisy, uv)
    coarse = truth.resized(COARSE)
    coarse = replace(coarse, beta_m=1.07 * truth.beta_m, beta_n=1.1 * truth.beta_n)
    fitted = mapped.with_maps(coarse)
    lights = tuple(dome(rig))
    cameras = ring(strands, rig)
    held = tuple(k for k in HELD_VIEWS if k < len(cameras))
    pictures, true, rendered = [], [], []
    for k, camera in enumerate(cameras):
        pixels = np.flatnonzero((coverage(shown, camera, 32)["hair"] > 0.7).ravel())
        halves = []
        for where, stream in ((shown, 0), (fitted, 1)):
            share = coverage(where, camera, 32)
            two = []
            for half in (0, 1):
                number = (seed << 10) + 100 * stream + 2 * k + half
                every = np.arange(camera.width * camera.height)
                _, rest = render_olat_parts(
                    where,
                    camera,
                    lights,
                    every,
                    spp=rig.spp // 2,
                    max_depth=rig.max_depth,
                    seed=number,
                )
                first = render_olat(
                    where,
                    camera,
                    lights,
                    pixels=pixels,
                    spp=DIRECT * rig.spp // 2,
                    max_depth=1,
                    thrift=0,
                    seed=number + 50,
                )
                size = (len(lights), camera.height, camera.width, 3)
                smooth = smoothed(rest.reshape(size), share, 1.5).reshape(len(lights), -1, 3)
                two.append(first + smooth[:, pixels])
            halves.append((two[0], two[1]))
        true.append(halves[0])
        rendered.append(halves[1])
        hits = find_hits(mapped, camera, pixels, HitOptions(16, seed))
        captured = np.float32(0.5) * (halves[0][0] + halves[0][1])
        valid = np.ones(captured.shape[:2], bool)
        pictures.append(Pictures(hits, lights, np.stack(halves[1]), captured, valid))
    held_lights = tuple(range(1, len(lights), 3))
    kept = [i for i in range(len(lights)) if i not in held_lights]
    seen = [p.captured[kept] for k, p in enumerate(pictures) if k not in held]
    scale = Exposure.of(x.reshape(-1, 3) for x in seen).scale
    return Frames(
        tuple(pictures),
        tuple(true),
        tuple(rendered),
        Places.of(uv),
        scale,
        held,
        held_lights,
        mapped,
        noisy,
    )


def interpolated(frames: Frames, progress: Progress) -> dict[str, dict[str, float]]:
    """Rows of interpolated frames: three nearest lights, standard, and guided (Photobooth §4)."""
    lights = frames.pictures[0].lights
    kept = [i for i in range(len(lights)) if i not in frames.held_lights]
    own = [k for k in range(len(frames.pictures)) if k not in frames.held_views]
    seen = [frames.pictures[k] for k in own]
    tables = [p.captured[kept].astype(np.float16) for p in seen]
    cameras = zip(seen, tables, strict=True)
    views = tuple(CapturedView(p.hits.camera, p.hits.pixels, t) for p, t in cameras)
    field = ReflectanceField(tuple(lights[i] for i in kept), views, 1.0)
    standard = Interpolation.of(field, frames.mapped, frames.strands)
    names = [light.name for light in field.lights]
    guide = searched(standard, names[1::3], cameras=1, progress=progress)
    rows = {}
    towards = np.array([x.position / np.linalg.norm(x.position) for x in lights])
    cosine = np.clip(towards @ towards[kept].T, -1, 1)
    order = np.argsort(-cosine, axis=1)[:, :3]
    weights = 1 / np.maximum(np.arccos(np.take_along_axis(cosine, order, axis=1)), 1e-6)
    weights /= weights.sum(axis=1, keepdims=True)
    near = {}
    for k, table in zip(own, tables, strict=True):
        mixed = np.einsum("ln,lnpc->lpc", weights, table[order].astype(float))
        near[k] = mixed, mixed
    rows["three nearest lights"] = frames.psnr(near)
    for name, one in (
        ("standard interpolation (Photobooth's)", standard),
        ("model-based interpolation (Photobooth's)", replace(standard, model=guide.best)),
    ):
        lit = {}
        for k, p in enumerate(frames.pictures):
            hits = one.sources[own.index(k)].hits if k in own else p.hits
            made = one.seen_by(hits).under(lights)[0]
            lit[k] = made, made
        rows[name] = frames.psnr(lit)
    return rows


def under_maps(frames: Frames, made: Callable[[int, Array], Pair]) -> float:
    """PSNR without noise of held-out views under `MAPS`, each exposed by its truth's mean.

    `made(view, weights)` is a view's pair of pictures `(P, 3)` under all lights times weights.
    """
    products = []
    for name in MAPS:
        weights = map_weights(name, frames.pictures[0].lights)
        for k in frames.held_views:
            true = summed(frames.true[k], weights)
            scale = 0.3 / float(np.mean(true))
            pairs = zip(made(k, weights), true, strict=True)
            a, b = (srgb(x * scale) - srgb(t * scale) for x, t in pairs)
            products.append((a * b).ravel())
    return float(-10 * np.log10(max(float(np.concatenate(products).mean()), 1e-6)))


def summed(pair: Pair, weights: Array) -> Pair:
    """Two pictures `(P, 3)` of two stacks `(L, P, 3)`."""
    one, other = (np.tensordot(weights, x, 1) for x in pair)
    return one, other


def in_brightest(frames: Frames, field: Field, k: int, weights: Array) -> Pair:
    """View k with the field's answer to the brightest light, for the light of all of them."""
    view = frames.pictures[k]
    at, light = field.at(view.hits), view.lights[int(np.argmax(weights))]
    one, other = summed(frames.rendered[k], weights)
    answer = at.answer(light)
    if not at.additive:
        return one * np.maximum(1 + answer, 0), other * np.maximum(1 + answer, 0)
    given = sum(w * at.irradiance(x) for w, x in zip(weights, view.lights, strict=True))
    if at.alone:
        return np.maximum(answer * given, 0), np.maximum(answer * given, 0)
    return np.maximum(one + answer * given, 0), np.maximum(other + answer * given, 0)


def map_weights(name: str, lights: Sequence[Light]) -> Array:
    """Of each of the lights, the part of a map that is nearer to it than to others `(L,)`."""
    envmap = environment_map(name).astype(float).mean(axis=2)
    height, width = envmap.shape
    z = np.cos(np.pi * (np.arange(height) + 0.5) / height)
    angle = (0.5 - (np.arange(width) + 0.5) / width) * 2 * np.pi
    flat = np.sqrt(1 - z**2)[:, None]
    texels = np.stack(
        np.broadcast_arrays(flat * np.cos(angle), flat * np.sin(angle), z[:, None]), axis=-1
    )
    towards = np.array([x.position / np.linalg.norm(x.position) for x in lights])
    nearest = (texels @ towards.T).argmax(axis=-1)
    sums = np.bincount(nearest.ravel(), (envmap * flat).ravel(), len(lights))
    return np.asarray(sums, float)


def rows_of(
    frames: Frames, fields: Mapping[str, FieldOptions], progress: Progress
) -> dict[str, Any]:
    """PSNR by group of every row of the table, and what the fits took."""
    training = frames.training()
    colour = np.mean([p.captured.mean(axis=(0, 1)) for p in training], axis=0)
    flat = {k: (np.broadcast_to(colour, t[0].shape),) * 2 for k, t in enumerate(frames.true)}
    rows: dict[str, Any] = {
        "mean colour": frames.psnr(flat),
        "inverse rendering": frames.psnr(dict(enumerate(frames.rendered))),
        **interpolated(frames, progress),
    }
    for name, options in fields.items():
        progress(name, 0.5)
        begun = time.process_time()
        found = fit_pictures(training, frames.places, frames.scale, options)
        seconds = time.process_time() - begun
        lit = {}
        for k, p in enumerate(frames.pictures):
            at = found.field.at(p.hits)
            one, other = (at.lit(x.astype(np.float32), p.lights) for x in frames.rendered[k])
            lit[k] = one, other
        rows[name] = {
            **frames.psnr(lit),
            BRIGHTEST: under_maps(frames, partial(in_brightest, frames, found.field)),
            "cpu_seconds": seconds,
            "ridge": found.ridge,
            "clamped": found.clamped,
            "kept": not found.doubts(),
            "validation": found.validation,
            "warnings": found.warnings,
        }
    return rows


def run_bench(
    out: Path,
    subjects: Sequence[Subject],
    rig: SmallStage = STAGE,
    *,
    seed: int = 0,
    fields: Mapping[str, FieldOptions] = FIELDS,
    progress: Progress = silent,
) -> dict[str, Any]:
    """The table of `fields`, a seed for each of `subjects`, and the solvers on the last."""
    result: dict[str, Any] = {"rig": asdict(rig), "seeds": []}
    for k, subject in enumerate(subjects):
        progress(f"seed {seed + k}: frames", k / len(subjects))
        begun = time.process_time()
        frames = frames_of(subject, rig, seed + k)
        made = time.process_time() - begun
        result["seeds"].append(
            {"frames_cpu_seconds": made, "rows": rows_of(frames, fields, progress)}
        )
        if k == len(subjects) - 1:
            training = frames.training()
            quick = rig is SIZES["quick"]
            result["solvers"] = curves(training, frames.places, frames.scale, quick=quick)
            result["ratio"] = ratio(result["solvers"])
        save(out / "fields.json", result)
    (out / "fields.md").write_text(report(result))
    return result


def report(result: Mapping[str, Any]) -> str:
    """The tables, for people."""
    seeds = [s["rows"] for s in result["seeds"]]
    lines = []
    for name in seeds[0]:
        cells = []
        for group in (*GROUPS, MAPPED, BRIGHTEST, "cpu_seconds"):
            values = [rows[name][group] for rows in seeds if group in rows[name]]
            found = spread(values) if values else {}
            sd = f" ± {found['sd']:.2f}" if "sd" in found else ""
            cells.append(f"{found['mean']:.2f}{sd}" if values else "")
        kept = [rows[name]["kept"] for rows in seeds if "kept" in rows[name]]
        lines.append([name, *cells, f"{sum(kept)} of {len(kept)}" if kept else ""])
    text = markdown(["model", *GROUPS, MAPPED, BRIGHTEST, "fit, CPU s", "kept"], lines) + "\n"
    for name, curve in result["solvers"].items():
        points = ", ".join(f"{p['cpu_seconds']:.2f} s: {p['above']:.1e}" for p in curve)
        text += f"- {name}: {points}\n"
    least = result["ratio"]
    if "cpu_seconds" in least:
        text += (
            f"- to {least['above']:.1e}: {least['cpu_seconds']:.2f} s, "
            f"Adam {least['adam_cpu_seconds']:.2f} s\n"
        )
    return text


def _bench(args: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    if args.cost:
        result = cost(tuple(args.cost), args.out, args.seed, progress)
        save(args.out / "fields_cost.json", result)
        return result
    rig = SIZES["quick"] if args.quick else STAGE
    count = 1 if args.quick else args.seeds
    subjects = [simulated(args.rig, args.subject, args.head, args.seed + k) for k in range(count)]
    fields = {name: FIELDS[name] for name in args.only or FIELDS}
    return run_bench(args.out, subjects, rig, seed=args.seed, fields=fields, progress=progress)


SEEDS = option("--seeds", "of the table", type=int, default=3)
ONLY = option(
    "--only", "of the fields, by name: all unless given", nargs="+", choices=tuple(FIELDS)
)
COST = option(
    "--cost",
    "only what a whole fit to synthetic pictures takes: hair pixels a view, views, lights",
    type=int,
    nargs=3,
)
BENCHMARK = Benchmark(_bench, (*SUBJECT, SEEDS, ONLY, COST))

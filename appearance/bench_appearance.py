"""Benchmark: the fit's ablations beside baselines, on subjects of known appearance."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from appearance.fit import FitOptions
from appearance.hair_appearance import HairAppearance
from appearance.hair_maps import HairMaps, MappedStrands
from appearance.metrics import LPIPS_UNAVAILABLE, psnr, ssim
from appearance.observations import Observed
from appearance.render.olat import render_olat
from appearance.stage1.loop import ROWS, Stage1Options, run
from appearance.stage1.problem import Effort, Problem
from appearance.stage1.start import hair_inverse
from appearance.stage1.subjects import SUBJECTS, Captured, Rig, subject
from appearance.stage1.unknowns import Lamps
from reconstruction.lights import Light
from reconstruction.mesh import Mesh
from reconstruction.report import Progress, Stage, silent
from reconstruction.strands import Strands

Array = NDArray[np.float64]
GROUPS = ("train views", "held-out views")
BASELINES = ("mean colour", "three nearest", "HairInverse")
TRUTH = "truth, fresh numbers"
"""The true parameters on the true strands: how far a PSNR can go with this much noise."""


class Table:
    """All rows of one subject; each fit starts from the last."""

    def __init__(
        self,
        captured: Captured,
        options: Stage1Options,
        *,
        lights: Sequence[Light] | None = None,
        progress: Progress = silent,
        seed: int = 0,
    ) -> None:
        self.captured, self.options = captured, options
        self.progress, self.seed = progress, seed
        self.training = captured.training(lights)
        self.rows: dict[str, dict[str, Any]] = {}

    def run(self, rows: Sequence[str] = tuple(ROWS)) -> dict[str, dict[str, Any]]:
        """Baselines, then `rows`, then the truth itself."""
        captured = self.captured
        colour = np.mean([o.radiance.mean((0, 1)) for o in self.training], axis=0)
        views, pairs = captured.views, self._truth()
        flat = [np.broadcast_to(colour, views[k].radiance[0].shape) for k, _ in pairs]
        self._score("mean colour", [(x, x) for x in flat])
        self._score(
            "three nearest",
            [
                (
                    self._nearest(views[k], captured.halves[k][0], i),
                    self._nearest(views[k], captured.halves[k][1], i),
                )
                for k, i in pairs
            ],
        )
        begun = time.perf_counter()
        self.progress("HairInverse", 0.0)
        stage = Stage("start")
        quick = FitOptions(hair_pixels=200, roughness_spp=12, colour_spp=8)
        hair, _ = hair_inverse(
            captured.mapped.scene, self.training, options=quick, stage=stage, seed=self.seed
        )
        maps = HairMaps.of(hair)
        self.score_maps("HairInverse", maps, captured.mapped, time.perf_counter() - begun)
        self.rows["HairInverse"]["warnings"] = stage.warnings
        lamps = None
        problem = Problem(captured.mapped, self.training, captured.exposure.scale, captured.skin)
        for row in rows:
            begun = time.perf_counter()
            self.progress(row, 0.0)
            found = run(
                problem,
                maps,
                lamps,
                options=replace(self.options, row=row),
                seed=self.seed,
                progress=_named(self.progress, row),
            )
            maps, lamps = found.maps, found.lamps
            self.score_maps(row, maps, captured.mapped, time.perf_counter() - begun)
            self.rows[row] |= {
                "ended": found.ended,
                "steps": found.steps,
                "gain_spread": float(found.lamps.gain.std()),
                "history": found.history,
            }
        self.score_maps(TRUTH, captured.truth, captured.true_mapped, 0.0)
        self.found = maps, lamps or Lamps.calibrated(len(self.training[0].lights))
        return self.rows

    def _truth(self) -> list[tuple[int, int]]:
        """Numbers of the views and of the held-out lights that are compared."""
        return [(k, i) for k in range(len(self.captured.views)) for i in self.captured.held_lights]

    def score_maps(self, row: str, maps: HairMaps, mapped: MappedStrands, seconds: float) -> None:
        """Render `maps` on `mapped` with fresh random numbers and score them as `row`."""
        scene = mapped.painted(maps).with_skin(self.captured.skin)
        held = list(self.captured.held_lights)
        pictures: list[tuple[Array, Array]] = []
        for k, o in enumerate(self.captured.views):
            one, other = (
                render_olat(
                    scene,
                    o.camera,
                    [o.lights[i] for i in held],
                    spp=self.captured.spp // 2,
                    max_depth=self.captured.max_depth,
                    pixels=o.pixels,
                    seed=(self.seed << 8) + 31 + 2 * k + h,
                ).astype(float)
                for h in (0, 1)
            )
            pictures += list(zip(one, other, strict=True))
        self._score(row, pictures)
        hair, true = maps.mean(), self.captured.truth.mean()
        self.rows[row] |= {
            "seconds": seconds,
            "sigma_a": list(hair.sigma_a),
            "beta_m": hair.beta_m,
            "beta_n": hair.beta_n,
            "eta": hair.eta,
            "beta_m_error": hair.beta_m / true.beta_m - 1,
            "sigma_a_error": float(np.abs(np.array(hair.sigma_a) / true.sigma_a - 1).max()),
        }

    def _score(self, row: str, pictures: Sequence[tuple[Array, Array]]) -> None:
        """Scores over held-out lights, in the training and in the held-out views.

        `pictures` are pairs of independent renderings `(P, 3)`. "psnr" and "ssim" compare their
        mean with the frames; "psnr_clean" is the PSNR without either side's noise, from the product
        of differences between independent halves.
        """
        captured, exposure = self.captured, self.captured.exposure
        groups: dict[str, list[tuple[float, float, float]]] = {n: [] for n in GROUPS}
        for (one, other), (k, i) in zip(pictures, self._truth(), strict=True):
            o, (true_one, true_other) = captured.views[k], captured.halves[k]
            size = (o.camera.height, o.camera.width)
            shown, true = (
                _image(exposure(x), o.pixels, size)
                for x in (0.5 * (one + other), o.radiance[i].astype(float))
            )
            mask = np.zeros(size, bool)
            mask.reshape(-1)[o.pixels] = True
            clean = (exposure(one) - exposure(true_one[i])) * (
                exposure(other) - exposure(true_other[i])
            )
            group = GROUPS[int(k in captured.held_views)]
            groups[group].append((psnr(shown, true, mask), ssim(shown, true, mask), clean.mean()))
        figures: dict[str, Any] = {"lpips": LPIPS_UNAVAILABLE}
        for group, values in groups.items():
            mean = np.mean(values, axis=0)
            figures[group] = {
                "psnr": float(mean[0]),
                "ssim": float(mean[1]),
                "psnr_clean": float(-10 * np.log10(max(mean[2], 1e-5))),
            }
        self.rows[row] = figures

    def _nearest(self, o: Observed, frames: NDArray[np.float32], light: int) -> Array:
        """The view's own frames under the three nearest training lights, by inverse angle."""
        towards = np.array([x.position / np.linalg.norm(x.position) for x in o.lights])
        others = list(self.captured.train_lights)
        angle = np.arccos(np.clip(towards[others] @ towards[light], -1, 1))
        three = np.argsort(angle)[:3]
        share = 1 / np.maximum(angle[three], 1e-6)
        near = frames[[others[i] for i in three]].astype(float)
        return np.asarray(np.tensordot(share / share.sum(), near, 1))


def _image(values: Array, pixels: NDArray[np.int64], size: tuple[int, int]) -> Array:
    out = np.zeros((size[0] * size[1], 3))
    out[pixels] = values
    return out.reshape(*size, 3)


QUICK = Stage1Options(
    steps=30,
    check_every=15,
    watched_views=2,
    shape=(6, 12, 12),
    effort=Effort(pixels=250, spp=24, gradient_spp=8, max_depth=8),
)
STAGE = Rig(size=36, cameras=5, lights=12, spp=160)
PLAIN_STEPS = 4
"""Of the plain version that are run; the rest of its curve is extrapolated and marked."""


def run_bench(
    out: Path,
    strands: Strands,
    head: Mesh | None,
    hair: HairAppearance,
    skin: Array,
    *,
    names: Sequence[str] = SUBJECTS,
    seeds: int = 1,
    options: Stage1Options = QUICK,
    rig: Rig = STAGE,
    plain: bool = True,
    progress: Progress = silent,
    seed: int = 0,
) -> dict[str, Any]:
    """The table of every subject, further `seeds` of (b) only, and error against run time on (b).

    Writes `appearance.json` and `appearance.md` into `out` and returns the former.
    """
    result: dict[str, Any] = {"options": asdict(options), "rig": asdict(rig), "subjects": {}}
    for name in names:
        captured = subject(name, strands, head, hair, skin, rig, seed)
        table = Table(captured, options, progress=_named(progress, name), seed=seed)
        result["subjects"][name] = table.run()
        if name == "b":
            result["seeds"] = [
                _final(Table(captured, options, seed=seed + k).run()) for k in range(1, seeds)
            ]
            if plain:
                result["time"] = error_against_time(captured, options, progress, seed)
    out.mkdir(parents=True, exist_ok=True)
    (out / "appearance.json").write_text(json.dumps(result, indent=1) + "\n")
    (out / "appearance.md").write_text(markdown(result))
    return result


def error_against_time(
    captured: Captured, options: Stage1Options, progress: Progress = silent, seed: int = 0
) -> dict[str, list[dict[str, float]]]:
    """Held-out PSNR of "spatial" against CPU seconds: ours, and ours with one choice undone.

    "plain" draws pairs evenly, renders whole frames one at a time to a fixed number of bounces, and
    starts from one colour; of its steps only the first are run. Watching is not counted.
    """
    training = captured.training()
    scale, skin = captured.exposure.scale, captured.skin
    ours = replace(options, row="spatial", check_every=max(2, options.steps // 3))
    even = replace(ours, residual_weighted=False, cell_start=False, shared_paths=False)
    frame = captured.views[0].camera.width * captured.views[0].camera.height
    versions = {
        "ours": ours,
        "one colour first": replace(ours, cell_start=False),
        "common numbers": replace(ours, common_numbers=True),
        "even batches": replace(ours, residual_weighted=False),
        "plain": replace(
            even,
            effort=replace(options.effort, pixels=frame, rr_depth=options.effort.max_depth),
            check_every=1,
            levels=1,
            steps=PLAIN_STEPS,
        ),
    }
    start = HairMaps.of(replace(captured.truth.mean(), sigma_a=(0.3, 0.3, 0.3), beta_m=0.4))
    curves = {}
    for name, version in versions.items():
        progress(f"time: {name}", 0.0)
        views = [_framed(o) for o in training] if name == "plain" else training
        points: list[tuple[float, HairMaps]] = []
        problem = Problem(captured.mapped, views, scale, skin)
        run(
            problem,
            start,
            options=version,
            snapshot=_into(points),
            seed=seed,
        )
        table = Table(captured, options, seed=seed)
        curve = []
        for seconds, maps in points:
            table.score_maps("now", maps, captured.mapped, seconds)
            psnr_clean = table.rows["now"][GROUPS[1]]["psnr_clean"]
            curve.append({"cpu_seconds": seconds, "psnr_clean": psnr_clean})
        curves[name] = curve
    return curves


def _framed(o: Observed) -> Observed:
    """All pixels of the camera, of which those beside the hair do not count."""
    pixels = np.arange(o.camera.width * o.camera.height)
    radiance = np.zeros((len(o.lights), len(pixels), 3), np.float32)
    valid = np.zeros(radiance.shape[:2], bool)
    radiance[:, o.pixels], valid[:, o.pixels] = o.radiance, o.valid
    return Observed(o.camera, o.lights, pixels, radiance, valid)


def _into(points: list[tuple[float, HairMaps]]) -> Callable[[float, HairMaps], None]:
    return lambda seconds, maps: points.append((seconds, maps))


def _named(progress: Progress, name: str) -> Progress:
    return lambda what, share: progress(f"({name}) {what}", share)


def _final(rows: dict[str, dict[str, Any]]) -> dict[str, float]:
    return {name: row[GROUPS[1]]["psnr_clean"] for name, row in rows.items()}


def markdown(result: dict[str, Any]) -> str:
    """The tables, for people."""
    lines = []
    for name, rows in result["subjects"].items():
        lines += [
            f"## Subject ({name})",
            "",
            "| row | held-out views, lights: PSNR without noise | PSNR | SSIM | training views, "
            "held-out lights: PSNR without noise | β_M off | mean σ off | s |",
            "|---|---|---|---|---|---|---|---|",
        ]
        for row, figures in rows.items():
            held, train = figures[GROUPS[1]], figures[GROUPS[0]]
            off = [
                f"{100 * figures[k]:+.1f} %" if k in figures else ""
                for k in ("beta_m_error", "sigma_a_error")
            ]
            lines.append(
                f"| {row} | {held['psnr_clean']:.2f} | {held['psnr']:.2f} | {held['ssim']:.3f} | "
                f"{train['psnr_clean']:.2f} | {off[0]} | {off[1]} | "
                f"{figures.get('seconds', 0):.0f} |"
            )
        lines.append("")
    for name, curve in result.get("time", {}).items():
        points = ", ".join(f"{p['cpu_seconds']:.0f} s: {p['psnr_clean']:.2f}" for p in curve)
        lines.append(f"- {name}: {points}")
    return "\n".join(lines) + "\n"

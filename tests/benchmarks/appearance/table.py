"""The ablation table: baselines, fits and the truth itself, scored on held-out frames."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from appearance import HairScene, InverseRenderingOptions, scores
from appearance.bsdf.maps import HairMaps, MappedStrands
from appearance.fields.anchors import Grid, Places, anchors_of
from appearance.fields.field import HITS
from appearance.fields.fit import fit_pictures
from appearance.fields.hits import HitOptions, find_hits
from appearance.fields.options import FieldOptions, FieldRequest
from appearance.fields.pictures import Pictures
from appearance.inverse_rendering.lobes import mean_level, with_lobes
from appearance.inverse_rendering.loop import Monitor, run
from appearance.inverse_rendering.memory import Sizes, memory_needed
from appearance.inverse_rendering.problem import FitProblem
from appearance.metrics.decision import MATERIAL, Material
from appearance.metrics.scores import mean_scores, scores_unavailable
from appearance.observations import Observed
from appearance.render.smoothed import olat_smoothed
from appearance.render.tracing import Sampling
from appearance.sun_fit.options import FitOptions
from benchmarks.appearance.hair_inverse import hair_inverse
from benchmarks.appearance.known_subjects import Captured
from benchmarks.command import within
from benchmarks.fields.modulation import BASELINE
from reconstruction import Light, Progress, Stage, silent
from reconstruction.arrays import Array, Floats, Ints
from reconstruction.report.report import peak_memory, resident_memory

GROUPS = ("train views", "held-out views")
TRUTH = "truth, fresh numbers"
"""The true parameters on the true strands: how far a PSNR can go with this much noise."""
FIELDS = {"full": FieldOptions(), "GaussianHair": FieldOptions("whole", **BASELINE)}
"""The last stage's material with a field, where the fit keeps it; a field without material."""


def visible_absorption(maps: HairMaps, mapped: MappedStrands, view: Observed) -> Array:
    """Mean sigma_a `(P, 3)` of what each pixel of a view shows of `mapped`; NaN without hair."""
    hits = find_hits(mapped, view.camera, view.pixels, HITS)
    grid = Grid.of(maps.shape, len(mapped.root_uv))
    number, low, high, share = anchors_of(hits, grid, Places.of(mapped.root_uv))
    table = maps.sigma_a.reshape(grid.count, 3)
    values = np.full((len(view.pixels) * hits.count, 3), np.nan)
    values[number] = table[low] * (1 - share[:, None]) + table[high] * share[:, None]
    each = values.reshape(len(view.pixels), hits.count, 3)
    count = np.isfinite(each).sum(axis=1)
    return np.asarray(np.nansum(each, axis=1) / np.where(count > 0, count, np.nan))


class Table:
    """All variants of one subject, and baselines; each fit starts from the last."""

    def __init__(
        self,
        captured: Captured,
        options: InverseRenderingOptions,
        *,
        lights: Sequence[Light] | None = None,
        progress: Progress = silent,
        seed: int = 0,
    ) -> None:
        self.captured, self.options = captured, options
        self.progress, self.seed = progress, seed
        self.training = captured.training(lights)
        self.variants: dict[str, dict[str, Any]] = {}

    def run(
        self, variants: Sequence[Material] = MATERIAL, fields: bool = False
    ) -> dict[str, dict[str, Any]]:
        """Baselines, `variants`, with `fields` the `FIELDS`, then the truth itself."""
        captured = self.captured
        colour = np.mean([o.radiance.mean((0, 1)) for o in self.training], axis=0)
        views, pairs = captured.views, self._truth()
        flat = [np.broadcast_to(colour, views[k].radiance[0].shape) for k, _ in pairs]
        self._score("mean colour", [(x, x) for x in flat])
        self._score(
            "three nearest",
            [
                (self._nearest(views[k], one, i), self._nearest(views[k], other, i))
                for k, i in pairs
                for one, other in [captured.halves[k]]
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
        self.variants["HairInverse"]["warnings"] = stage.warnings
        gain = None
        problem = FitProblem(captured.mapped, self.training, captured.exposure.scale, captured.skin)
        sizes = Sizes([len(o.pixels) for o in self.training], len(self.training[0].lights))
        lit, level = self.training[0].single_lights, 1.0
        for variant in variants:
            begun = time.perf_counter()
            self.progress(variant, 0.0)
            worked = time.process_time()
            held = resident_memory() or 0.0
            with peak_memory() as peak:
                found = run(
                    problem,
                    maps,
                    gain,
                    stages=(variant,),
                    options=self.options,
                    seed=self.seed,
                    monitor=Monitor(within(self.progress, f"({variant})")),
                )
            worked = time.process_time() - worked
            maps, gain = found.maps, found.gain
            if found.lobes is not None and np.isfinite(found.lobes[:, 3]).any():
                lit = tuple(x for x in with_lobes(lit, found.lobes) if isinstance(x, Light))
                level = mean_level(problem, found.lobes, gain)
            self.score_maps(variant, maps, captured.mapped, time.perf_counter() - begun, level)
            self.variants[variant] |= {
                "cpu_seconds": worked,
                "memory_gb": peak.gb,
                "memory_estimated_gb": held + memory_needed(sizes, self.options),
                "decision": found.decisions[0].to_dict(),
                "gain_spread": float(found.gain.std()),
            }
        gain = np.ones(len(lit)) if gain is None else gain
        if fields:
            self._fields(maps, [x.scaled(g) for x, g in zip(lit, gain, strict=True)], level)
        self.score_maps(TRUTH, captured.truth, captured.true_mapped, 0.0)
        self.found = maps, gain
        return self.variants

    def _truth(self) -> list[tuple[int, int]]:
        """Numbers of the views and of the held-out lights that are compared."""
        return list(self.captured.judged)

    def _fields(self, maps: HairMaps, lights: Sequence[Light], level: float) -> None:
        """Score `FIELDS` on top of `maps` under the fitted `lights`, as a user's fit makes them.

        Held-out lights have `level`.
        """
        captured, request = self.captured, FieldRequest()
        mapped, rng = captured.mapped, np.random.default_rng(self.seed)
        scene = mapped.with_maps(maps).with_skin(captured.skin)
        _, most = request.resolved(len(self.training), len(mapped.root_uv))
        views = []
        for o in self.training:
            few = np.sort(rng.permutation(len(o.pixels))[:most])
            pixels, hits = o.pixels[few], HitOptions(request.hits, self.seed)
            halves = []
            for seed in (2 * self.seed, 2 * self.seed + 1):
                half = Sampling(request.spp // 2, captured.rig.max_depth, seed)
                halves.append(olat_smoothed(scene, o.camera, lights, half, pixels=pixels))
            found = find_hits(mapped, o.camera, pixels, hits)
            frames = o.radiance[:, few], o.valid[:, few]
            views.append(Pictures(found, tuple(lights), np.stack(halves), *frames))
        rendered = self._rendered(scene, level)
        for name, options in FIELDS.items():
            self.progress(name, 0.0)
            worked = time.process_time()
            fit = fit_pictures(views, Places.of(mapped.root_uv), captured.exposure.scale, options)
            worked = time.process_time() - worked
            images = []
            for k, judged in self._judged().items():
                o, pair = captured.views[k], rendered[k]
                if fit.decision.kept or options.kind == "whole":
                    at = fit.field.at(find_hits(mapped, o.camera, o.pixels, HITS))
                    under = [o.single_lights[i].scaled(level) for i in judged]
                    pair = at.lit(pair[0], under), at.lit(pair[1], under)
                images += list(zip(*pair, strict=True))
            self._score(name, images)
            self.variants[name] |= {
                "cpu_seconds": worked,
                "decision": fit.decision.to_dict(),
                "ridge": fit.ridge,
                "warnings": fit.warnings,
            }

    def _judged(self) -> dict[int, list[int]]:
        """Numbers of the held-out lights that pictures are judged under, by that of the view."""
        found: dict[int, list[int]] = {}
        for k, i in self.captured.judged:
            found.setdefault(k, []).append(i)
        return found

    def _rendered(self, scene: HairScene, level: float = 1.0) -> dict[int, tuple[Floats, Floats]]:
        """Two pictures `(L, P, 3)` of each judged view with fresh random numbers, all lights
        `level` times as bright."""
        rig, out = self.captured.rig, {}
        for k, judged in self._judged().items():
            o = self.captured.views[k]
            lights = [o.single_lights[i].scaled(level) for i in judged]
            sampling = (rig.judged_spp, (self.seed << 8) + 31 + 2 * k)
            out[k] = rig.halves(scene, o.camera, lights, o.pixels, sampling)
        return out

    def score_maps(
        self,
        variant: str,
        maps: HairMaps,
        mapped: MappedStrands,
        seconds: float,
        level: float = 1.0,
    ) -> None:
        """Render `maps` on `mapped` under held-out lights of `level`, and score them."""
        captured, true = self.captured, self.captured.truth
        rendered = self._rendered(mapped.with_maps(maps).with_skin(captured.skin), level)
        pairs = [p for k in self._judged() for p in zip(*rendered[k], strict=True)]
        self._score(variant, [(a.astype(float), b.astype(float)) for a, b in pairs])
        views = [captured.views[k] for k in self._judged()]
        shown, true_shown = (
            np.concatenate([visible_absorption(m, on, o) for o in views])
            for m, on in ((maps, mapped), (true, captured.true_mapped))
        )
        both = np.isfinite(shown[:, 0] + true_shown[:, 0])
        mean, true_mean = shown[both].mean(axis=0), true_shown[both].mean(axis=0)
        self.variants[variant] |= {
            "seconds": seconds,
            "sigma_a": mean.tolist(),
            "beta_m": maps.beta_m,
            "beta_n": maps.beta_n,
            "eta": maps.eta,
            "beta_m_error": maps.beta_m / true.beta_m - 1,
            "beta_n_error": maps.beta_n / true.beta_n - 1,
            "sigma_a_error": float(np.abs(mean / true_mean - 1).max()),
            "visible_sigma_a_error": float(np.median(np.abs(shown[both] / true_shown[both] - 1))),
        }

    def _score(self, variant: str, pictures: Sequence[tuple[Array, Array]]) -> None:
        """Scores over held-out lights, in the training and in the held-out views.

        `pictures` are pairs of independent renderings `(P, 3)`. "psnr" and "ssim" compare their
        mean with the frames; "psnr_clean" is the PSNR without either side's noise, from the product
        of differences between independent halves.
        """
        captured, exposure = self.captured, self.captured.exposure
        groups: dict[str, list[dict[str, float]]] = {n: [] for n in GROUPS}
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
            groups[group].append({**scores(shown, true, mask), "clean": float(clean.mean())})
        figures: dict[str, Any] = scores_unavailable()
        for group, values in groups.items():
            mean = mean_scores(values)
            mean["psnr_clean"] = float(-10 * np.log10(max(mean.pop("clean"), 1e-5)))
            figures[group] = mean
        self.variants[variant] = figures

    def _nearest(self, o: Observed, frames: Floats, light: int) -> Array:
        """The view's own frames under the three nearest training lights, by inverse angle."""
        towards = np.array([x.position / np.linalg.norm(x.position) for x in o.lights])
        others = list(self.captured.train_lights)
        angle = np.arccos(np.clip(towards[others] @ towards[light], -1, 1))
        three = np.argsort(angle)[:3]
        share = 1 / np.maximum(angle[three], 1e-6)
        near = frames[[others[i] for i in three]].astype(float)
        return np.asarray(np.tensordot(share / share.sum(), near, 1))


def _image(values: Array, pixels: Ints, size: tuple[int, int]) -> Array:
    out = np.zeros((size[0] * size[1], 3))
    out[pixels] = values
    return out.reshape(*size, 3)

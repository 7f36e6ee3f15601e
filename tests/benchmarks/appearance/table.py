"""The ablation table: baselines, fits and the truth itself, scored on held-out frames."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from appearance import InverseRenderingOptions, scores
from appearance.bsdf.maps import HairMaps, MappedStrands
from appearance.inverse_rendering.loop import Monitor, run
from appearance.inverse_rendering.memory import Sizes, memory_needed
from appearance.inverse_rendering.problem import FitProblem
from appearance.metrics.decision import MATERIAL, Material
from appearance.metrics.scores import mean_scores, scores_unavailable
from appearance.observations import Observed
from appearance.sun_fit.options import FitOptions
from benchmarks.appearance.hair_inverse import hair_inverse
from benchmarks.appearance.known_subjects import Captured
from benchmarks.command import within
from reconstruction import Light, Progress, Stage, silent
from reconstruction.arrays import Array, Floats, Ints
from reconstruction.report.report import peak_memory, resident_memory

GROUPS = ("train views", "held-out views")
TRUTH = "truth, fresh numbers"
"""The true parameters on the true strands: how far a PSNR can go with this much noise."""


def absorption_of_hair(maps: HairMaps, root_uv: Array, points: int = 16) -> Array:
    """sigma_a `(points, S, 3)` evenly along strands with these roots: of cells that have hair."""
    _, columns, rows = maps.shape
    u, v = np.minimum(root_uv * (columns, rows), (columns - 1, rows - 1)).astype(int).T
    return np.asarray(maps.resized((points, columns, rows)).sigma_a[:, u, v])


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

    def run(self, variants: Sequence[Material] = MATERIAL) -> dict[str, dict[str, Any]]:
        """Baselines, then `variants`, then the truth itself."""
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
            self.score_maps(variant, maps, captured.mapped, time.perf_counter() - begun)
            self.variants[variant] |= {
                "cpu_seconds": worked,
                "memory_gb": peak.gb,
                "memory_told_gb": held + memory_needed(sizes, self.options),
                "decision": found.decisions[0].to_dict(),
                "gain_spread": float(found.gain.std()),
            }
        self.score_maps(TRUTH, captured.truth, captured.true_mapped, 0.0)
        self.found = maps, np.ones(len(self.training[0].lights)) if gain is None else gain
        return self.variants

    def _truth(self) -> list[tuple[int, int]]:
        """Numbers of the views and of the held-out lights that are compared."""
        return list(self.captured.judged)

    def score_maps(
        self, variant: str, maps: HairMaps, mapped: MappedStrands, seconds: float
    ) -> None:
        """Render `maps` on `mapped` with fresh random numbers and score them as `variant`."""
        scene = mapped.with_maps(maps).with_skin(self.captured.skin)
        rig, pairs = self.captured.rig, self._truth()
        pictures: list[tuple[Array, Array]] = []
        for k in dict.fromkeys(k for k, _ in pairs):
            o = self.captured.views[k]
            lights = [o.single_lights[i] for view, i in pairs if view == k]
            sampling = (rig.judged_spp, (self.seed << 8) + 31 + 2 * k)
            one, other = rig.halves(scene, o.camera, lights, o.pixels, sampling)
            pictures += list(zip(one.astype(float), other.astype(float), strict=True))
        self._score(variant, pictures)
        true = self.captured.truth
        sigma_a = absorption_of_hair(maps, mapped.root_uv)
        true_sigma_a = absorption_of_hair(true, self.captured.true_mapped.root_uv)
        mean, true_mean = sigma_a.mean(axis=(0, 1)), true_sigma_a.mean(axis=(0, 1))
        self.variants[variant] |= {
            "seconds": seconds,
            "sigma_a": mean.tolist(),
            "beta_m": maps.beta_m,
            "beta_n": maps.beta_n,
            "eta": maps.eta,
            "beta_m_error": maps.beta_m / true.beta_m - 1,
            "beta_n_error": maps.beta_n / true.beta_n - 1,
            "sigma_a_error": float(np.abs(mean / true_mean - 1).max()),
        }
        if sigma_a.shape == true_sigma_a.shape:  # the strands correspond
            off = np.abs(sigma_a / true_sigma_a - 1)
            self.variants[variant]["sigma_a_along_hair_error"] = float(np.median(off))

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

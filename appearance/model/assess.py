"""Rendered against captured: held-out lights, a held-out camera, beside trivial baselines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np

from appearance.metrics.pictures import Row, comparison_picture
from appearance.metrics.scores import (
    Exposure,
    mean_scores,
    psnr,
    relative_error,
    scores,
    scores_unavailable,
    ssim,
)
from appearance.model.fitted_model import FittedModel
from appearance.model.options import AssessOptions
from appearance.model.relight import relight
from appearance.observations import HeldOut, Observed, observe_hair
from appearance.render.smoothed import olat_smoothed
from appearance.render.tracing import Sampling
from appearance.scene.hair_appearance import DiffuseHair
from appearance.scene.hair_scene import HairScene
from appearance.sun_fit.roughness_and_colour import fit_diffuse
from reconstruction import Capture, Light, Model, Progress, Stage, silent
from reconstruction.arrays import AnyFloats, Bools

METHODS = ("ours", "mean_colour", "diffuse", "three_nearest")
COLUMNS = ("captured", "ours", "diffuse", "three_nearest")
MAX_DEPTH = 16


@dataclass(frozen=True, eq=False)
class _Compared:
    """One frame by every method, radiance `(H, W, 3)`, and where the hair is."""

    camera: str
    light: str
    frames: dict[str, AnyFloats]
    mask: Bools


def assess(
    capture: Capture,
    model: Model,
    *,
    held_out: HeldOut,
    environment: str = "studio",
    options: AssessOptions | None = None,
    progress: Progress = silent,
    seed: int = 0,
) -> dict[str, Any]:
    """Compare a fitted model with the frames it was not fitted to, and relight it.

    The model is judged as `FittedModel` renders it: with hair maps and lights as found where there
    are any. Returns `{"held_out_lights": {method: {"psnr", "ssim", "relative_error"}},
    "held_out_camera": …}` with the methods "ours", "mean_colour" (one colour: the mean over
    training frames and hair pixels), "diffuse" (Lambertian fibres on our strands whose albedo
    reproduces that mean) and "three_nearest" (the camera's own captured frames under the three
    nearest other training lights, interpolated: a baseline that needs the camera's frames, also
    where that camera is held out). Means over images, each over the captured hair mask. A group
    with nothing held out is left out. "lpips" is a score like the others where its weights are
    given (`appearance.metrics.lpips`), and a reason beside the groups where not.

    Writes `comparison.png` where there is something to compare, `relit.png` and `relit.exr` (see
    `relight`) and the stage "images" of the report.
    """
    options = options or AssessOptions()
    training = held_out.training(capture)
    fitted = FittedModel.load(model, capture)
    result: dict[str, Any] = {}
    report = model.report()
    with report.stage("images") as stage:
        if held_out.cameras or held_out.lights:
            comparison = _Comparison(capture, training, model, fitted, held_out, options, seed)
            result = comparison.run(stage, progress)
        else:
            stage.warn("no camera and no light is held out: nothing is compared")
        progress("relighting", 0.8)
        size, spp = options.relit_size, options.relit_spp
        relight(fitted, model, environment, size=size, spp=spp, seed=seed)
    model.write_report(report)
    progress("images compared", 1.0)
    return {**result, **scores_unavailable()}


@dataclass(frozen=True, eq=False)
class _Comparison:
    """What is compared with what."""

    capture: Capture
    training: Capture
    model: Model
    fitted: FittedModel
    held_out: HeldOut
    options: AssessOptions
    seed: int

    def run(self, stage: Stage, progress: Progress) -> dict[str, Any]:
        """The scores by group and method; writes `comparison.png`."""
        scene, exposure = self.fitted.scene(), self.fitted.appearance.exposure
        progress("fitting the baselines", 0.0)
        training = self._observed()
        colour = np.mean([o.radiance[o.valid].mean(axis=0) for o in training], axis=0)
        albedo = fit_diffuse(scene, training, seed=self.seed)
        scenes = {"ours": scene, "diffuse": scene.with_hair(DiffuseHair(albedo))}
        groups: dict[str, list[_Compared]] = {}
        for group, views in self._views().items():
            groups[group] = []
            for i, (camera, lights) in enumerate(views):
                progress(f"rendering {camera}", 0.1 + 0.3 * len(groups) * (i + 1) / len(views))
                groups[group] += self._compared(camera, lights, scenes, colour)
        result: dict[str, Any] = {
            group: {name: _scores(images, name, exposure) for name in METHODS}
            for group, images in groups.items()
        }
        judge(result, stage)
        stage.figures |= {**result, "diffuse_albedo": list(albedo), **scores_unavailable()}
        with self.model.writing("comparison.png") as part:
            comparison_picture(part, _rows(groups, exposure), COLUMNS)
        return result

    def _observed(self) -> list[Observed]:
        """Hair pixels of the training cameras under some of the training lights."""
        rng, most = np.random.default_rng(self.seed), self.options.baseline_pixels
        names = _spread(self.training.olat_lights(), self.options.baseline_lights)
        lights = tuple(self.fitted.lights(names))
        seen = observe_hair(self.training, self.model, names, most, rng)
        return [replace(o, lights=lights) for o in seen]

    def _views(self) -> dict[str, list[tuple[str, list[str]]]]:
        """Which cameras to compare under which lights, by group."""
        held_out, options = self.held_out, self.options
        new = _spread(held_out.lights, options.lights)
        training = self.training.olat_lights()
        views: dict[str, list[tuple[str, list[str]]]] = {}
        if new:
            cameras = _spread([c.name for c in self.training.rig.cameras], options.cameras)
            views["held_out_lights"] = [(camera, new) for camera in cameras]
        if held_out.cameras:
            both = _spread(training, max(options.lights - len(new) // 2, 1))
            both += _spread(new, len(new) // 2)
            cameras = _spread(held_out.cameras, options.cameras)
            views["held_out_camera"] = [(camera, both) for camera in cameras]
        return views

    def _compared(
        self, camera: str, names: Sequence[str], scenes: dict[str, HairScene], colour: AnyFloats
    ) -> list[_Compared]:
        """The frames of one camera under the lights `names`, by every method."""
        capture = self.capture
        mask = self.model.mask(camera, "hair", capture)
        names = [n for n in names if capture.has_light(n, camera)]
        if not names or not mask.any():
            return []
        device, lights = capture.rig.camera(camera), self.fitted.lights(names)
        sampling = Sampling(self.options.spp, MAX_DEPTH, self.seed)
        rendered = {m: olat_smoothed(s, device, lights, sampling) for m, s in scenes.items()}
        training = self.training.olat_lights()
        out = []
        for i, name in enumerate(names):
            captured = capture.light(name, camera)[0]
            frames = {
                "captured": captured,
                **{method: images[i] for method, images in rendered.items()},
                "mean_colour": np.broadcast_to(colour, captured.shape),
                "three_nearest": three_nearest(capture, camera, capture.rig.light(name), training),
            }
            out.append(_Compared(camera, name, frames, mask))
        return out


def three_nearest(
    capture: Capture, camera: str, light: Light, training: Sequence[str]
) -> AnyFloats:
    """`camera`'s frames `(H, W, 3)` under the three `training` lights nearest to `light`, mixed.

    Weights go with the inverse angle about the head; each frame is scaled by intensity over squared
    distance to what `light` would give. `light` itself is never among the three.
    """
    names = [n for n in training if n != light.name and capture.has_light(n, camera)]
    others = [capture.rig.light(n) for n in names]
    positions = np.array([o.position for o in others])
    distance = np.linalg.norm(positions, axis=1)
    own = float(np.linalg.norm(light.position))
    cosine = positions @ light.position / (distance * own)
    angle = np.arccos(np.clip(cosine, -1, 1))
    nearest = np.argsort(angle)[:3]
    weights = 1.0 / np.maximum(angle[nearest], 1e-6)
    weights /= weights.sum()
    total = np.zeros(1)
    for k, weight in zip(nearest, weights, strict=True):
        here, there = (x.intensity_towards(np.zeros(3)) for x in (light, others[k]))
        gain = here / np.maximum(there, 1e-12)
        gain *= (distance[k] / own) ** 2
        total = total + weight * gain * capture.light(names[k], camera)[0]
    return np.asarray(total)


def _scores(images: Sequence[_Compared], method: str, exposure: Exposure) -> dict[str, float]:
    """Means over `images` of a method's `metrics.scores` and relative error on the hair."""
    found = []
    for image in images:
        radiance, truth = image.frames[method], image.frames["captured"]
        relative = relative_error(radiance, truth, image.mask)
        shown = scores(exposure(radiance), exposure(truth), image.mask)
        found.append({**shown, "relative_error": relative})
    return mean_scores(found)


def judge(result: dict[str, Any], stage: Stage) -> None:
    """Warn where a trivial baseline is not beaten."""
    pairs = product(("mean_colour", "diffuse"), ("psnr", "ssim"))
    for (group, rows), (baseline, figure) in product(result.items(), pairs):
        if rows["ours"][figure] <= rows[baseline][figure]:
            stage.warn(f"{group}: the baseline {baseline} is not beaten in {figure}")


def _rows(groups: dict[str, list[_Compared]], exposure: Exposure) -> list[Row]:
    """Two rows a group for the picture, with their scores."""
    rows: list[Row] = []
    for group, images in groups.items():
        # the frames that show most: brightly lit hair, and from different cameras where there are
        ranked = sorted(images, key=lambda c: -float(c.frames["captured"][c.mask].mean()))
        picked = ranked[:1]
        picked += [c for c in ranked if c.camera != picked[0].camera][:1] or ranked[1:2]
        for c in picked:
            shown: dict[str, AnyFloats] = {k: exposure(v) for k, v in c.frames.items()}
            captions = {
                k: f"{psnr(v, shown['captured'], c.mask):.1f} dB  "
                f"{ssim(v, shown['captured'], c.mask):.2f}"
                for k, v in shown.items()
                if k != "captured"
            }
            rows.append((f"{group.replace('_', ' ')}\n{c.camera}, {c.light}", shown, captions))
    return rows


def _spread(items: Sequence[str], most: int) -> list[str]:
    """`most` of `items`, evenly spread, or all where there are fewer."""
    if len(items) <= most:
        return list(items)
    return [items[int((i + 0.5) * len(items) / most)] for i in range(most)]

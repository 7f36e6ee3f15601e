"""Rendered and baseline images compared with held-out lights and a held-out camera."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
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
from appearance.model.baselines import NearestCameras, other_lights, three_nearest
from appearance.model.fitted_model import FittedModel
from appearance.model.from_frames import FromFrames, NewViews
from appearance.model.options import AssessOptions
from appearance.observations import HeldOut, Observed, observe_hair
from appearance.render.smoothed import olat_smoothed
from appearance.render.tracing import Sampling
from appearance.scene.hair_appearance import DiffuseHair
from appearance.scene.hair_scene import HairScene
from appearance.sun_fit.fit_pixels import FitPixels, covered
from appearance.sun_fit.roughness_and_colour import fit_diffuse
from reconstruction import Camera, Capture, Light, Model, Progress, Stage, silent
from reconstruction.arrays import AnyFloats, Array, Bools

FITS = ("ours", "sun_fit", "inverse_rendering", "without_field", "from_frames")
"""Methods in the results that are not baselines."""
OWN_FRAMES = "three_nearest_own_frames"
"""A reference with the held-out camera's own frames, without a warning."""
INTERPOLATED = {
    "three_nearest": "three nearest lights",
    "nearest_cameras": "three nearest cameras",
    OWN_FRAMES: "its own frames",
}
SHOWN = {"held_out_lights": 4, "held_out_camera": 2}
"""Rows of the comparison by group."""
MAX_DEPTH = 16
FRAMES_SPP = 8
"""Of the training cameras' images for `FromFrames`."""
BASELINE_PIXELS, BASELINE_LIGHTS = 100, 48  # of each camera: what mean colour and albedo come from


@dataclass(frozen=True, eq=False)
class _Compared:
    """One frame by every method, radiance `(H, W, 3)`, and where the hair is, unless saturated."""

    camera: Camera
    light: Light
    frames: dict[str, AnyFloats]
    mask: Bools


def assess(
    capture: Capture,
    model: Model,
    *,
    held_out: HeldOut,
    options: AssessOptions | None = None,
    progress: Progress = silent,
    seed: int = 0,
) -> dict[str, Any]:
    """Compare a fitted model with held-out frames.

    Returns `{"held_out_lights": {method: {"psnr", "ssim", "relative_error"}}, "held_out_camera":
    …}`, means over images, each over the captured hair mask; a group with nothing held out is left
    out. "rendered" names the fit of the material, "lpips" the reason if that score is missing. The
    methods are "ours", the parts of it ("sun_fit", "inverse_rendering", "without_field"), and

    - "from_frames": see `FromFrames`; left out without another camera that shows hair
    - "mean_colour": the mean over training frames and hair pixels
    - "diffuse": Lambertian fibres on our strands, with the albedo that reproduces that mean
    - "three_nearest", of held-out lights: the camera's frames under the three nearest training
      lights, interpolated
    - "nearest_cameras", of a held-out camera: other cameras' frames projected on our geometry, see
      `NearestCameras`; left out without another camera, or if one meets no strand
    - "three_nearest_own_frames", of a held-out camera: its own frames, which no other method has,
      under the three nearest other training lights

    Writes `comparison.png` and the stage "images" of the report, which warns of every baseline that
    is not beaten.
    """
    options = options or AssessOptions()
    training = held_out.training(capture)
    fitted = FittedModel.load(model, capture)
    result: dict[str, Any] = {}
    report = model.report()
    with report.stage("images") as stage:
        if not training.olat_lights():
            stage.warn("baselines and scores need single lights: nothing is compared")
        elif held_out.cameras or held_out.lights:
            comparison = _Comparison(capture, training, model, fitted, held_out, options, seed)
            result = comparison.run(stage, progress)
            shutil.rmtree(model.work("images"), ignore_errors=True)
        else:
            stage.warn("no camera and no light is held out: nothing is compared")
    model.write_report(report)
    progress("images compared", 1.0)
    return {**result, **scores_unavailable()}


@dataclass(frozen=True, eq=False)
class _Comparison:
    """The data of a comparison."""

    capture: Capture
    training: Capture
    model: Model
    fitted: FittedModel
    held_out: HeldOut
    options: AssessOptions
    seed: int

    def run(self, stage: Stage, progress: Progress) -> dict[str, Any]:
        """The scores by group and method; writes `comparison.png`."""
        exposure = self.fitted.appearance.exposure
        progress("fitting the baselines", 0.0)
        training = self._observed()
        seen = [o.radiance[o.valid] for o in training if o.valid.any()]
        colour = np.mean([x.mean(axis=0) for x in seen], axis=0)
        scene = self.fitted.scene()
        albedo = fit_diffuse(scene, covered(FitPixels(training), scene).hair, seed=self.seed)
        both = FittedModel.alternatives(self.model, self.capture)
        lit = {name: (fit.scene(), fit) for name, fit in both.items()}
        if self.fitted.field is not None and not both:
            bare = self.fitted.without_field()
            lit["without_field"] = bare.scene(), bare
        if self.fitted.field is not None or not both:
            lit["ours"] = scene, self.fitted
        lit["diffuse"] = scene.with_hair(DiffuseHair(albedo)), self.fitted
        rendered = "inverse_rendering" if self.model.has("hair_maps.npz") else "sun_fit"
        groups: dict[str, list[_Compared]] = {}
        for k, (group, views) in enumerate(self._views().items()):
            groups[group] = []
            for i, (camera, lights) in enumerate(views):
                progress(f"rendering {camera}", 0.1 + 0.4 * (k + i / len(views)))
                for image in self._rendered(camera, lights, lit, stage):
                    if "ours" not in lit:
                        image.frames["ours"] = image.frames[rendered]
                    image.frames["mean_colour"] = np.broadcast_to(colour, (*image.mask.shape, 3))
                    groups[group].append(image)
            progress("relighting frames", 0.5 + 0.4 * k)
            self._interpolate(groups[group], scene, own=group == "held_out_lights")
            if not groups[group]:
                stage.warn(f"{group}: no frame of it shows lit hair: nothing is compared")
        result: dict[str, Any] = {
            group: {
                n: _scores(images, n, exposure)
                for n in images[0].frames
                if n != "captured" and all(n in image.frames for image in images)
            }
            for group, images in groups.items()
            if images
        }
        judge(result, stage)
        result["rendered"] = rendered
        stage.figures |= {**result, "diffuse_albedo": list(albedo), **scores_unavailable()}
        shown = "ours" in lit  # by itself, beside what it is made of
        others = [name for name in lit if name in FITS[1:] and (shown or name != rendered)]
        columns = ["captured", "ours", *others, "diffuse", "interpolated"]
        rows = [r for g, images in groups.items() for r in self._rows(g, images, exposure)]
        self.model.remove("comparison.png")
        if rows:
            with self.model.writing("comparison.png") as part:
                comparison_picture(part, rows, columns)
        return result

    def _observed(self) -> list[Observed]:
        """Hair pixels of the training cameras under some of the training lights."""
        rng, most = np.random.default_rng(self.seed), BASELINE_PIXELS
        names = _spread(self.training.olat_lights(), BASELINE_LIGHTS)
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

    def _rendered(
        self,
        name: str,
        lights: Sequence[str],
        lit: Mapping[str, tuple[HairScene, FittedModel]],
        stage: Stage,
    ) -> list[_Compared]:
        """The frames of one camera under `lights`: captured, and of each scene under its lights."""
        capture, camera = self.capture, self.capture.rig.camera(name)
        mask = self.model.mask(name, "hair", capture)
        training, rig = self.training.olat_lights(), capture.rig
        names = [n for n in lights if capture.has_light(n, name)]
        names = [n for n in names if other_lights(capture, name, rig.light(n), training)]
        if not names or not mask.any():
            return []
        sampling = Sampling(self.options.spp, MAX_DEPTH, self.seed)
        images = {
            method: olat_smoothed(scene, camera, fit.lights(names), sampling)
            for method, (scene, fit) in lit.items()
        }
        out = []
        for i, n in enumerate(names):
            captured, saturated = capture.light(n, name)
            frames: dict[str, AnyFloats] = {"captured": captured}
            frames |= {method: rendered[i] for method, rendered in images.items()}
            if captured[judged := mask & ~saturated].any():
                out.append(_Compared(camera, capture.rig.light(n), frames, judged))
            else:
                stage.warn(f"{name}, {n}: the hair is black or saturated: not compared")
        return out

    def _interpolate(self, images: Sequence[_Compared], scene: HairScene, *, own: bool) -> None:
        """Add the baselines made of frames; `own` where the camera is one of the training's."""
        training, views = self.training.olat_lights(), dict[str, NearestCameras | None]()
        if not images:
            return
        folder = self.model.work("images")  # of a large capture they exceed memory
        frames = FromFrames.of(self.fitted, self.model, self.training, folder=folder)
        lights = self.fitted.lights(list({image.light.name: None for image in images}))
        relit: NewViews | None = None
        if not own and len(frames.field.views) > 1:
            sampling = Sampling(FRAMES_SPP, MAX_DEPTH, self.seed)
            cameras = [v.camera for v in frames.field.views]
            lit = {c.name: olat_smoothed(scene, c, lights, sampling) for c in cameras}
            relit = NewViews.of(frames, [[light] for light in lights], lit)
        for image in images:
            base, number = image.frames["ours"], [x.name for x in lights].index(image.light.name)
            shot = frames.view(image.camera)
            if shot is not None:
                image.frames["from_frames"], _ = frames.relit(shot, [lights[number]], base)
            elif relit is not None:
                image.frames["from_frames"], _ = relit(image.camera, base, number)
            camera, light = image.camera, image.light
            mixed = three_nearest(self.capture, camera.name, light, training)
            image.frames["three_nearest" if own else OWN_FRAMES] = mixed
            if own:
                continue
            if camera.name not in views:
                mask = self.model.mask(camera.name, "hair", self.capture)
                views[camera.name] = NearestCameras.of(self.training, camera, scene, mask)
            view = views[camera.name]
            if view is not None:
                image.frames["nearest_cameras"] = view(light)

    def _rows(self, group: str, images: Sequence[_Compared], exposure: Exposure) -> list[Row]:
        """`SHOWN` rows of a group for the image, with their scores."""
        middle = self.fitted.strands.points.mean(axis=0).astype(float)
        by_camera: dict[str, list[_Compared]] = {}
        for image in images:
            by_camera.setdefault(image.camera.name, []).append(image)
        rows: list[Row] = []
        for shown in by_camera.values():
            camera, lights = shown[0].camera, [image.light for image in shown]
            for k, angle in front_lights(
                camera, lights, middle, -(-SHOWN[group] // len(by_camera))
            ):
                image, light = shown[k], lights[k].name
                pictures: dict[str, AnyFloats] = {n: exposure(f) for n, f in image.frames.items()}
                how = next(n for n in INTERPOLATED if n in pictures)
                pictures["interpolated"] = pictures[how]
                captions = {
                    n: f"{psnr(p, pictures['captured'], image.mask):.1f} dB  "
                    f"{ssim(p, pictures['captured'], image.mask):.2f}"
                    for n, p in pictures.items()
                    if n != "captured"
                }
                captions["interpolated"] += f"  {INTERPOLATED[how]}"
                label = f"{group.replace('_', ' ')}\n{camera.name}, {light} at {angle:.0f}°"
                rows.append((label, pictures, captions))
        return rows[: SHOWN[group]]


def front_lights(
    camera: Camera, lights: Sequence[Light], middle: Array, most: int
) -> list[tuple[int, float]]:
    """Which `lights` to show: indices, and angles in degrees to the camera's direction.

    Directions are from the hair's `middle (3,)`. First the light nearest to the camera, then, up to
    `most` and within 90 degrees of the camera, the one furthest from those chosen.
    """
    own = camera.center - middle
    towards = np.array([light.position for light in lights]) - middle
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    cosine = np.clip(towards @ own / np.linalg.norm(own), -1, 1)
    left = [int(k) for k in np.argsort(-cosine) if cosine[k] > 0]
    chosen = left[:1] or [int(np.argmax(cosine))]
    while len(chosen) < min(most, len(left)):
        nearest = (towards @ towards[chosen].T).max(axis=1)
        chosen.append(min((k for k in left if k not in chosen), key=lambda k: float(nearest[k])))
    return [(k, float(np.degrees(np.arccos(cosine[k])))) for k in chosen]


def _scores(images: Sequence[_Compared], method: str, exposure: Exposure) -> dict[str, float]:
    """Means over `images` of a method's `metrics.scores` and relative error on the hair."""
    found = []
    for image in images:
        radiance, truth = image.frames[method], image.frames["captured"]
        relative = relative_error(radiance, truth, image.mask)
        shown = scores(exposure(radiance), exposure(truth), image.mask)
        found.append({**shown, "relative_error": relative})
    return mean_scores(found)


def judge(result: Mapping[str, Any], stage: Stage) -> None:
    """Warn of every baseline that is not beaten, except `OWN_FRAMES`."""
    for group, rows in result.items():
        for baseline in rows:
            if baseline in FITS or baseline == OWN_FRAMES:
                continue
            for figure, unit in (("psnr", " dB"), ("ssim", "")):
                ours, other = rows["ours"][figure], rows[baseline][figure]
                if ours <= other:
                    stage.warn(
                        f"{group}: the baseline {baseline} is not beaten in {figure}: "
                        f"{ours:.3g}{unit} against its {other:.3g}"
                    )


def _spread(items: Sequence[str], most: int) -> list[str]:
    """`most` of `items`, evenly spread, or all where there are fewer."""
    if len(items) <= most:
        return list(items)
    return [items[int((i + 0.5) * len(items) / most)] for i in range(most)]

"""Hair and skin pixels that a fit observes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from appearance.metrics.scores import Exposure
from appearance.observations import Observed, chosen, observe
from appearance.render.coverage import pixel_coverage
from appearance.scene.hair_scene import SCALE, HairScene
from appearance.sun_fit.options import FitOptions
from reconstruction import Capture, Model, Progress, Stage
from reconstruction.arrays import Array
from reconstruction.capture.records import origin

SKIN_PIXELS = 200
"""Skin pixels read from each camera."""
COVERED = 0.9
"""Share of a pixel that the model's hair, or skin, covers where colours are compared."""
FOREIGN = 0.1
"""Share of the strands in view outside a camera's hair mask above which a user is warned."""
_SAMPLES = 4000  # pixels of a camera for that share


@dataclass(frozen=True, eq=False)
class FitPixels:
    """Observed hair, and skin if any is visible."""

    hair: Sequence[Observed]
    skin: Sequence[Observed] = ()


def observed_pixels(
    training: Capture,
    model: Model,
    options: FitOptions,
    stage: Stage,
    progress: Progress,
    seed: int,
) -> FitPixels:
    """Read hair and skin of all cameras; raises `ValueError` if there is no hair or it is dark."""
    rng = np.random.default_rng(seed)
    cameras, lights = [c.name for c in training.rig.cameras], training.lightings()
    hair, skin, hair_pixels = [], [], 0
    has_head = model.head(training) is not None
    for i, name in enumerate(cameras):
        progress("reading hair pixels", 0.3 * i / len(cameras))
        mask = model.mask(name, "hair", training)
        bare = model.mask(name, "skin", training) & ~mask
        hair_pixels += int(mask.sum())
        wanted = chosen(mask, options.hair_pixels, rng)
        uncovered = chosen(bare if has_head else bare & False, SKIN_PIXELS, rng)
        both = observe(training, name, lights, np.concatenate([wanted, uncovered]))
        is_hair = np.arange(len(both.pixels)) < len(wanted)
        if len(wanted):
            hair.append(both.where(is_hair))
        if len(uncovered) >= 10:
            skin.append(both.where(~is_hair))
        if missing := int((~both.valid.any(axis=1)).sum()):
            stage.warn(f"{name}: {missing} of {len(lights)} lights have no usable frame")
    if not hair:
        raise ValueError(f"{model}: the hair masks of the cameras {cameras} are all empty")
    if not any((o.radiance[o.valid] > 0).any() for o in hair):
        raise ValueError(
            f"{training.path}: every hair pixel of every frame is dark, saturated or missing: "
            "check the exposure"
        )
    kept = sum(len(o.pixels) for o in hair)
    stage.figures |= {"cameras": len(cameras), "lights": len(lights), "hair_pixels": kept}
    if kept < hair_pixels:
        stage.leave_out(
            f"{hair_pixels - kept} of {hair_pixels} hair pixels",
            "the others determine means and lobes to one per cent",
            f"{1 - kept / hair_pixels:.0%} of the renderings",
        )
    return FitPixels(hair, skin)


def reached(training: Capture, pixels: FitPixels, exposure: Exposure, stage: Stage) -> FitPixels:
    """Without the lights that reach no hair pixel of any camera."""
    hair, noise = pixels.hair, 0.0
    for o in hair[:1]:
        for step in training.of_kind("dark"):
            if training.has(step, o.camera.name):
                frame = training.frame(step, o.camera.name).reshape(-1, 3)[o.pixels]
                noise = max(noise, float(frame.std()))
    threshold = max(5 * noise, 1e-3 / exposure.scale)
    peak = np.max([np.where(o.valid[..., None], o.radiance, 0).max((1, 2)) for o in hair], axis=0)
    lit = np.flatnonzero(peak > threshold)
    if len(lit) < len(peak):
        names = [hair[0].lights[i].name for i in np.flatnonzero(peak <= threshold)]
        stage.leave_out(
            f"{len(names)} of {len(peak)} lights: {', '.join(names[:5])} …",
            "they reach no hair pixel",
            f"{len(names) / len(peak):.0%} of the shadow rays",
        )
    if len(lit) == 0:
        raise ValueError(f"{training.path}: no light reaches a hair pixel")
    stage.figures["lights_that_reach_hair"] = len(lit)
    return FitPixels(*([o.under(lit) for o in some] for some in (pixels.hair, pixels.skin)))


def check_strands(
    training: Capture, model: Model, scene: HairScene, stage: Stage, seed: int
) -> None:
    """Warn of strands and masks that are probably of another capture.

    `stage` gets the share, by camera, of the pixels covered by strands that its hair mask lacks.
    """
    origins = [s.figures.get("capture") for s in model.report().stages if s.name == "masks"]
    if origins and None not in (made := origins[0], this := origin(training.plan)) and made != this:
        stage.warn(
            f"The model's masks are those of another capture, {made}, not of this one, {this}: "
            "run hairstage reconstruct on this one, unless nothing has moved."
        )
    rng, outside = np.random.default_rng(seed), {}
    for camera in training.rig.cameras:
        mask = model.mask(camera.name, "hair", training).reshape(-1)
        pixels = chosen(np.ones_like(mask), _SAMPLES, rng)
        shown = pixels[pixel_coverage(scene, camera, pixels)["hair"] >= COVERED]
        if len(shown):
            outside[camera.name] = float(1 - mask[shown].mean())
    stage.figures["strands_outside_masks"] = outside
    if outside and max(outside.values()) > FOREIGN:
        worst = max(outside, key=lambda name: outside[name])
        stage.warn(
            f"{outside[worst]:.0%} of the strands that {worst} shows lie outside its hair mask "
            f"(more than {FOREIGN:.0%} in {sum(x > FOREIGN for x in outside.values())} of "
            f"{len(outside)} cameras): check that strands and cameras are of this capture."
        )


def covered(pixels: FitPixels, scene: HairScene) -> FitPixels:
    """Pixels that the scene's hair or head covers by `COVERED`; all if that is less than a tenth.

    Elsewhere missing strands would bias the rendered colour.
    """

    def of(views: Sequence[Observed], what: str) -> Sequence[Observed]:
        shares = [pixel_coverage(scene, o.camera, o.pixels)[what] for o in views]
        shown = [o.where(share >= COVERED) for o, share in zip(views, shares, strict=True)]
        left = sum(len(o.pixels) for o in shown)
        enough = 10 * left >= sum(len(o.pixels) for o in views)
        return [o for o in shown if len(o.pixels)] if enough else views

    return FitPixels(of(pixels.hair, "hair"), of(pixels.skin, "head"))


def in_front(pixels: FitPixels, scene: HairScene) -> FitPixels:
    """The hair under lights on its camera's side of the scene; under all lights if there is none.

    Transmitted light depends on the strands' density, which a reconstruction determines less well
    than their positions.
    """
    nearer = [
        (o, np.flatnonzero(cosines_of_lights(scene, o) > 0).astype(np.int64)) for o in pixels.hair
    ]
    lit = [o.under(lights) for o, lights in nearer if len(lights)]
    return replace(pixels, hair=lit if any(o.valid.any() for o in lit) else pixels.hair)


def cosines_of_lights(scene: HairScene, o: Observed) -> Array:
    """Cosine `(L,)` between the directions from the scene's middle to each light and the camera."""
    middle = np.array(scene.mi_scene.bbox().center()).ravel() / SCALE
    ways = np.array([x.position for x in o.lights]).reshape(-1, 3) - middle
    towards = o.camera.center - middle
    lengths = np.linalg.norm(ways, axis=1) * np.linalg.norm(towards)
    return np.asarray(ways @ towards / np.maximum(lengths, 1e-12))

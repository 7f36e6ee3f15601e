"""Held-out frames beside the fit's renderings: scores and error maps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from appearance.metrics.pictures import Row, comparison_picture, small
from appearance.metrics.scores import Exposure, mean_scores, relative_error, scores
from appearance.observations import HeldOut, Observed, observe
from appearance.render.olat import render_olat
from appearance.render.tracing import Sampling
from appearance.scene.hair_scene import HairScene
from reconstruction import Capture, Model, Rig
from reconstruction.arrays import AnyFloats, Array, Bools, Floats

MAGNIFIED = 4.0
"""Factor on the differences of displayed values in error maps."""


@dataclass(frozen=True, eq=False)
class Judged:
    """A scene, and the rig whose lights it is rendered under: calibrated, or as found."""

    scene: HairScene
    rig: Rig


def held_out_frames(capture: Capture, model: Model, held_out: HeldOut, most: int) -> list[Observed]:
    """At most three held-out cameras under held-out lights, `most` frames, spread evenly.

    Where no camera or no light is held out, all there are take their place.
    """
    cameras = held_out.cameras or tuple(c.name for c in capture.rig.cameras)
    lights = held_out.lights or tuple(capture.olat_lights())
    if not (held_out.cameras or held_out.lights):
        return []
    out = []
    cameras = cameras[:: -(-len(cameras) // 3)]
    for name in cameras:
        there = [x for x in lights if capture.has_light(x, name)]
        some = there[:: max(1, -(-len(there) // max(1, most // len(cameras))))]
        pixels = np.flatnonzero(model.mask(name, "hair", capture))
        if len(pixels) and some:
            out.append(observe(capture, name, some, pixels))
    return out


def judge(
    model: Model,
    frames: Sequence[Observed],
    fits: Mapping[str, Judged],
    exposure: Exposure,
    sampling: Sampling,
) -> dict[str, dict[str, float]]:
    """Mean `metrics.scores` and "relative_error" of each of `fits` over lit `frames`; {} of none.

    Pixels that are saturated in a frame are skipped there.

    Writes the model's `inverse_rendering.png`: each frame as captured, as each fit renders it, and
    the last one's error map.
    """
    found: dict[str, list[dict[str, float]]] = {name: [] for name in fits}
    rows: list[Row] = []
    for k, o in enumerate(frames):
        spent = asdict(replace(sampling, seed=(sampling.seed << 8) + 91 + k))
        rendered = {
            name: render_olat(
                fit.scene,
                o.camera,
                [fit.rig.light(light.name) for light in o.lights],
                pixels=o.pixels,
                **spent,
            )
            for name, fit in fits.items()
        }
        mask = np.zeros((o.camera.height, o.camera.width), bool)
        mask.reshape(-1)[o.pixels] = True
        for i, light in enumerate(o.lights):
            true, judged = _image(o.radiance[i], mask), mask.copy()
            judged[mask] = o.valid[i]
            if not true[judged].any():
                continue
            wanted = exposure(true)
            shown: dict[str, AnyFloats] = {"captured": wanted}
            captions = {}
            for name, values in rendered.items():
                image = _image(values[i], mask)
                shown[name] = exposure(image)
                score = scores(shown[name], wanted, judged)
                captions[name] = f"{score['psnr']:.1f} dB"
                found[name].append({**score, "relative_error": relative_error(image, true, judged)})
            shown["error"] = MAGNIFIED * np.abs(shown[name] - wanted)
            captions["error"] = f"of {name}, x {MAGNIFIED:g}"
            shown = {name: small(picture) for name, picture in shown.items()}
            rows.append((f"{o.camera.name}, {light.name}", shown, captions))
    if not rows:
        return {}
    with model.writing("inverse_rendering.png") as part:
        comparison_picture(part, rows, ["captured", *fits, "error"])
    return {name: mean_scores(images) for name, images in found.items()}


def _image(values: Floats, mask: Bools) -> Array:
    out = np.zeros((*mask.shape, 3))
    out[mask] = values
    return out

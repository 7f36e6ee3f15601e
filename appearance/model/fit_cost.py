"""Seconds and memory of a fit's stages, estimated by rendering the model for some seconds."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from appearance.fields.options import FieldRequest
from appearance.fields.pipeline import memory_needed as field_memory
from appearance.inverse_rendering.lobes import paths_a_pixel, without_axis
from appearance.inverse_rendering.loop import SHARED_LIGHTS, SHARED_VIEWS
from appearance.inverse_rendering.memory import Sizes, memory_needed, scene_memory
from appearance.inverse_rendering.options import InverseRenderingRequest
from appearance.inverse_rendering.pipeline import reduced_for_fit
from appearance.inverse_rendering.problem import direct_spp, judging_spp
from appearance.metrics.decision import FitStage
from appearance.model.fitted_model import FittedModel
from appearance.observations import HeldOut
from appearance.render.coverage import pixel_coverage
from appearance.render.olat import render_olat
from appearance.render.smoothed import AREA
from appearance.render.smoothed import memory_needed as frames_memory
from appearance.sun_fit.options import FitOptions
from reconstruction import Capture, Model
from reconstruction.geometry.lights import components
from reconstruction.report.report import resident_memory

_PROBE_PIXELS, _PROBE_SPP, _PROBE_LIGHTS = 400, 16, 4
_PATHS = {"sun": 5e5, "shared": 87.0, "correctives": 5e5, "field": 3e5}
"""Paths of the stages whatever the size, in paths of the probe; of shared for each of a patch's."""
_SUN_PATH, _CELL_PATH, _TURN_PATH, _LOBE_PATH = 19.0, 24.0, 1.4, 5.5
"""Further ones: of sun for each colour path of an observed pixel (9 renderings, each path twice the
probe's), of spatial for each path of a round (12 of them), of correctives for each cached path and
light, and of each coarse path for the axes of lights, where none is determined."""
_LIBRARIES_GB = 0.15
"""Of LLVM, which the first rendering loads."""
_SUN_BYTES = 100
"""Of a pixel under a light: copies of frames, and three renderings at once."""
_FIELD_PIXEL, _DIRECT, _INDIRECT = 35.0, 1.2, 0.044
"""Of a field for each fitted pixel, and for each pixel and light of rendered images: direct light,
and each path of indirect light."""
_JUDGED = 2
"""Images of a held-out frame for each guess; the first stage has two guesses."""
_SAMPLES = 10_000
"""Pixels of an image for the share of it that shows the subject."""


@dataclass(frozen=True)
class StageCost:
    """Expected `seconds` of a stage on this machine, and the process's `peak_gb`."""

    name: FitStage
    seconds: float
    peak_gb: float


def estimate_fit(
    capture: Capture,
    model: Model,
    *,
    held_out: HeldOut,
    stages: Sequence[FitStage],
    sun: FitOptions,
    request: InverseRenderingRequest,
    field: FieldRequest,
) -> list[StageCost]:
    """The cost of each of `stages`, without the reading of frames.

    Raises `ModelError` or `CaptureError` for what is missing.
    """
    base = (resident_memory() or 0.0) + _LIBRARIES_GB
    training = held_out.training(capture)
    hair = [int(model.mask(c.name, "hair", training).sum()) for c in training.rig.cameras]
    lightings = [training.lighting(name) for name in training.lightings()]
    lights, views, strands = len(lightings), len(hair), model.strands()
    path, share = _seconds_a_path(training, model)
    shown = [round(share * c.width * c.height) for c in training.rig.cameras]
    effort = request.fit.effort
    pixels, observed = ([min(n, x) for n in hair] for x in (request.hair_pixels, sun.hair_pixels))
    fitted = len(components(lightings[: request.lights + request.validation_lights])[0])
    of_patches = min(SHARED_VIEWS, views) * min(SHARED_LIGHTS, fitted)
    small = reduced_for_fit(training, model, request.hair_pixels)
    judging = [round(share * c.width * c.height) for c in small.rig.cameras]
    held = min(request.validation_lights, fitted // 4)
    a_pixel = _DIRECT + _INDIRECT * judging_spp(sum(pixels), effort)
    judged = _JUDGED * a_pixel * (sum(judging) * held + max(judging) * (fitted - held))
    shared = _PATHS["shared"] * of_patches * effort.pixels * effort.spp / SHARED_LIGHTS + judged
    cells = sum(pixels) * np.clip(1e5 // max(sum(pixels), 1), 1, max(effort.spp // 4, 1))
    of_cells = _CELL_PATH * cells
    turned = any(map(without_axis, lightings))
    cached = sum(pixels) * direct_spp(sum(pixels)) * min(fitted, request.lights)
    lobes = sum(pixels) * 2 * (paths_a_pixel(sum(pixels), effort) // 8)
    most_lights, most = field.resolved(views, len(strands))
    of_field, many = [min(n, most) for n in hair], min(lights, most_lights)
    paths = {
        "sun": _PATHS["sun"] + _SUN_PATH * sun.colour_spp * sum(observed),
        "shared": shared + judged,
        "spatial": of_cells + judged,
        "correctives": _PATHS["correctives"] + _TURN_PATH * cached + judged,
        "lights": shared + (_LOBE_PATH * lobes if turned else of_cells * ("spatial" in stages)),
        # indirect light of all of the subject's pixels is smoothed, that of few has more paths
        "field": _PATHS["field"]
        + (_FIELD_PIXEL + _DIRECT * many) * sum(of_field)
        + _INDIRECT * field.spp * many * sum(map(min, shown, [AREA * x for x in of_field])),
    }
    points = len(strands.points)
    frames = max(map(frames_memory, training.rig.cameras, shown, [many] * len(shown), of_field))
    memory = {
        "sun": scene_memory(points, 1e-9 * _SUN_BYTES * lights * sum(observed), mapped=False),
        "field": scene_memory(
            points, max(frames, field_memory(of_field, many, len(strands), field))
        ),
    }
    material = memory_needed(Sizes(pixels, fitted, points), request.fit)
    return [StageCost(x, path * paths[x], base + memory.get(x, material)) for x in stages]


def _seconds_a_path(training: Capture, model: Model) -> tuple[float, float]:
    """Of a path under four lights, with brown hair, in the middle camera; and the share of its
    image that shows the subject."""
    scene = FittedModel.unfitted(model, training).scene()
    cameras = training.rig.cameras
    camera = cameras[len(cameras) // 2]
    hair = np.flatnonzero(model.mask(camera.name, "hair", training))
    pixels = hair[:: -(-max(len(hair), 1) // _PROBE_PIXELS)]
    lights = [training.lighting(name) for name in training.lightings()][:_PROBE_LIGHTS]
    seconds = []
    for seed in range(4):  # kernels are compiled in the first
        begun = time.perf_counter()
        render_olat(scene, camera, lights, pixels=pixels, spp=_PROBE_SPP, seed=seed)
        seconds.append(time.perf_counter() - begun)
    some = np.linspace(0, camera.width * camera.height - 1, _SAMPLES).astype(np.int64)
    covered = pixel_coverage(scene, camera, some)
    share = float((covered["hair"] + covered["head"] > 0).mean())
    return min(seconds[1:]) / max(len(pixels) * _PROBE_SPP, 1), share

"""Seconds and memory of a fit's stages, estimated by rendering the model for some seconds."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from appearance.fields.options import FieldRequest
from appearance.fields.pipeline import memory_needed as field_memory
from appearance.inverse_rendering.loop import SHARED_LIGHTS, SHARED_VIEWS
from appearance.inverse_rendering.memory import Sizes, memory_needed
from appearance.inverse_rendering.options import InverseRenderingRequest
from appearance.metrics.decision import FitStage
from appearance.model.fitted_model import FittedModel
from appearance.observations import HeldOut
from appearance.render.olat import render_olat
from reconstruction import Capture, Model
from reconstruction.geometry.lights import components
from reconstruction.report.report import resident_memory

_PROBE_PIXELS, _PROBE_SPP, _PROBE_LIGHTS = 400, 16, 4
_PATHS = {"sun": 2.7e6, "shared": 87.0, "spatial": 6e5, "correctives": 1.1e6}
"""Paths of the stages, in paths of the probe: of sun, spatial and correctives in all; of shared for
each of a patch's."""
_FIELD_DIRECT, _FIELD_LIGHT = 30.0, 2.3
"""Of a field, a pixel's paths beside `spp`: of direct light, and for each light."""
_JUDGED = 1 << 20
"""Paths of the held-out frames of a guess."""


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
    request: InverseRenderingRequest,
    field: FieldRequest,
) -> list[StageCost]:
    """The cost of each of `stages`, without the reading of frames.

    Raises `ModelError` or `CaptureError` for what is missing.
    """
    training = held_out.training(capture)
    hair = [int(model.mask(c.name, "hair", training).sum()) for c in training.rig.cameras]
    lightings = [training.lighting(name) for name in training.lightings()]
    lights, strands = len(lightings), model.strands()
    path, base = _seconds_a_path(training, model), resident_memory() or 0.0
    effort = request.fit.effort
    pixels = [min(n, request.hair_pixels) for n in hair]
    fitted = len(components(lightings[: request.lights + request.validation_lights])[0])
    views = min(SHARED_VIEWS, len(pixels)) * min(SHARED_LIGHTS, fitted)
    judged = min(_JUDGED, 16 * effort.spp * sum(pixels))
    shared = _PATHS["shared"] * views * effort.pixels * effort.spp / SHARED_LIGHTS + judged
    most_lights, most = field.resolved(len(hair), len(strands))
    of_field, many = [min(n, most) for n in hair], min(lights, most_lights)
    paths = {
        "sun": _PATHS["sun"],
        "shared": shared,
        "spatial": _PATHS["spatial"] + shared,
        "correctives": _PATHS["correctives"] + judged,
        "lights": shared,
        # every pixel of hair is rendered, for what is smooth
        "field": sum(hair) * (field.spp + _FIELD_DIRECT + _FIELD_LIGHT * many),
    }
    material = memory_needed(Sizes(pixels, fitted, len(strands.points)), request.fit)
    memory = {"field": field_memory(of_field, many, len(strands), field)}
    return [StageCost(x, path * paths[x], base + memory.get(x, material)) for x in stages]


def _seconds_a_path(training: Capture, model: Model) -> float:
    """Of a path under four lights, with brown hair, in the middle camera."""
    scene = FittedModel.unfitted(model, training).scene()
    cameras = training.rig.cameras
    camera = cameras[len(cameras) // 2]
    hair = np.flatnonzero(model.mask(camera.name, "hair", training))
    pixels = hair[:: -(-max(len(hair), 1) // _PROBE_PIXELS)]
    lights = [training.lighting(name) for name in training.lightings()][:_PROBE_LIGHTS]
    seconds = []
    for seed in range(2):  # kernels are compiled in the first
        begun = time.perf_counter()
        render_olat(scene, camera, lights, pixels=pixels, spp=_PROBE_SPP, seed=seed)
        seconds.append(time.perf_counter() - begun)
    return seconds[-1] / max(len(pixels) * _PROBE_SPP, 1)

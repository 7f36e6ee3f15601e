"""The pictures of a model under a new environment."""

from __future__ import annotations

from appearance.model.animation import turning_light, write_animation
from appearance.model.fitted_model import FittedModel
from appearance.model.options import AssessOptions
from appearance.model.relight import relight
from appearance.render.environment_maps import environment_map
from appearance.render.mixed import Environment
from appearance.render.tracing import Sampling
from reconstruction import Capture, Model, Progress, silent

MAX_DEPTH = 16
TURNING_SIZE, TURNING_SPP = 256, 6
"""Of `relit.webp`."""


def relight_model(
    capture: Capture,
    model: Model,
    *,
    environment: str = "studio",
    options: AssessOptions | None = None,
    progress: Progress = silent,
    seed: int = 0,
) -> None:
    """Relight a fitted model.

    Writes `relit.png` and `relit.exr` (see `relight`), `relit.webp` if `options.turning_frames` is
    above 0 (see `turning_light`), and the stage "relighting" of the report.
    """
    options = options or AssessOptions()
    envmap = environment_map(environment)
    report = model.report()
    with report.stage("relighting"):
        progress("relighting", 0.0)
        fitted = FittedModel.load(model, capture)
        size, spp = options.relit_size, options.relit_spp
        relight(fitted, model, envmap, size=size, spp=spp, seed=seed)
        if options.turning_frames:
            progress("relighting under light that turns", 0.6)
            room = Environment(envmap)
            sampling = Sampling(TURNING_SPP, MAX_DEPTH, seed)
            turning = turning_light(fitted, room, options.turning_frames, TURNING_SIZE, sampling)
            write_animation(model.file("relit.webp"), turning)
        else:
            model.remove("relit.webp")
    model.write_report(report)
    progress("relit", 1.0)

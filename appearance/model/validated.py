"""Inverse rendering that has to prove itself: some training frames decide what is rendered."""

from __future__ import annotations

from typing import Any

import numpy as np

from appearance.inverse_rendering.options import InverseRenderingRequest
from appearance.inverse_rendering.pipeline import fit_maps
from appearance.observations import HeldOut
from reconstruction import Capture, Model, Progress, silent
from reconstruction.arrays import Array


def fit_validated(
    capture: Capture,
    model: Model,
    *,
    held_out: HeldOut | None = None,
    request: InverseRenderingRequest | None = None,
    progress: Progress = silent,
    seed: int = 0,
) -> dict[str, Any]:
    """`fit_maps` under some lights, and Sun's fit kept where others say that it is better.

    Of the lights that are not `held_out`, `request.lights` are fitted and others judge,
    `request.validation_lights` or a quarter of them all: directions far apart. Where the mean PSNR
    of the validation frames is not higher than that of Sun's fit, maps and lights go to the model's
    folder "rejected" with a warning in the report: whatever is rendered later is Sun's fit. Returns
    what `fit_maps` does, with `{"validation": {"start" | "inverse_rendering": {"psnr", "ssim",
    "relative_error"}}}` instead of "held_out", and "rendered": "inverse_rendering" or "sun_fit".
    """
    held_out, request = held_out or HeldOut(), request or InverseRenderingRequest()
    training = held_out.training(capture)
    names = training.olat_lights()
    judges = min(request.validation_lights, len(names) // 4)
    directions = np.array([training.rig.light(name).position for name in names])
    order = far_apart(directions, request.lights + judges)
    used = [names[k] for k in order]
    model.remove("rejected")
    result = fit_maps(
        training.view(lights=used),
        model,
        held_out=HeldOut((), tuple(used[len(used) - judges :])),
        request=request,
        progress=progress,
        seed=seed,
    )
    report = model.report()
    stage = report["inverse_rendering"]
    stage.figures.pop("held_out", None)
    validation, rendered = result.pop("held_out", {}), "inverse_rendering"
    if validation:
        sun, found = (validation[name]["psnr"] for name in ("start", "inverse_rendering"))
        if found <= sun:
            rendered = "sun_fit"
            model.reject_maps()
            stage.warn(
                f"on frames that neither was fitted to Sun's fit is better, {sun:.2f} dB against "
                f"{found:.2f}: it is what is rendered"
            )
    else:
        stage.warn("too few lights to leave some out: nothing says whether the maps are better")
    result |= {"validation": validation, "rendered": rendered, "lights": len(used) - judges}
    stage.figures |= result
    model.write_report(report)
    return result


def far_apart(positions: Array, most: int) -> list[int]:
    """Indices of `most` of `positions (N, 3)`, or of all: the first, then the furthest from those.

    The distance is the angle about the origin.
    """
    towards = positions / np.linalg.norm(positions, axis=1, keepdims=True)
    chosen = [0]
    nearest = towards @ towards[0]
    while len(chosen) < min(most, len(positions)):
        nearest[chosen] = np.inf
        chosen.append(int(np.argmin(nearest)))
        nearest = np.maximum(nearest, towards @ towards[chosen[-1]])
    return chosen

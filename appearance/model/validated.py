"""Fits with validation: some training frames decide what is rendered."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from appearance.fields.field import FIELD_FILE
from appearance.fields.options import FieldRequest
from appearance.fields.pipeline import Rendered, fit_field
from appearance.inverse_rendering.options import InverseRenderingRequest
from appearance.inverse_rendering.pipeline import FILES, fit_maps
from appearance.model.fitted_model import FittedModel
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
    """`fit_maps` under some lights, kept if it renders validation lights better than Sun's fit.

    Of the lights that are not `held_out`, `request.lights` are fitted and
    `request.validation_lights` (or a quarter) validate, with directions far apart. If full training
    images are not clearly better, or the mean PSNR of the validation frames is not higher, maps and
    lights are discarded with a warning in the report. Returns the result of `fit_maps` with
    `{"validation": {"start" | "inverse_rendering": {"psnr", "ssim", "relative_error"}}}` instead of
    "held_out", and "rendered": "inverse_rendering" or "sun_fit".
    """
    held_out, request = held_out or HeldOut(), request or InverseRenderingRequest()
    training = held_out.training(capture)
    names = training.olat_lights()
    judges = min(request.validation_lights, len(names) // 4)
    directions = np.array([training.rig.light(name).position for name in names])
    order = far_apart(directions, request.lights + judges)
    used = [names[k] for k in order]
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
    if not result["accepted"]:
        rendered = "sun_fit"
    elif validation:
        sun, found = (validation[name]["psnr"] for name in ("start", "inverse_rendering"))
        if found <= sun:
            rendered = "sun_fit"
            for name in FILES:
                model.remove(name)
            better = "is better" if found < sun - 0.005 else "is as good"
            stage.warn(
                f"Sun's fit {better} on frames that neither was fitted to, {sun:.2f} dB against "
                f"{found:.2f}: it is rendered"
            )
    else:
        stage.warn("too few lights to leave some out: nothing says whether the maps are better")
    doubts = result.pop("doubts")
    if rendered == "inverse_rendering":
        stage.warnings += doubts
    result |= {"validation": validation, "rendered": rendered, "lights": len(used) - judges}
    stage.figures |= result
    model.write_report(report)
    return result


def fit_field_validated(
    capture: Capture,
    model: Model,
    *,
    held_out: HeldOut | None = None,
    request: FieldRequest | None = None,
    progress: Progress = silent,
    seed: int = 0,
) -> dict[str, Any]:
    """Fit a field to the model's residual, kept only if it improves left-out images.

    Of the lights that are not `held_out`, `request.lights` are used, with directions far apart.
    Cameras and lights are left out in turn; the field is kept if images under new lights, of new
    views, and of both each gain, and the mean by more than twice its spread. Otherwise it is
    discarded with a warning in the report, and an earlier field stays. Writes `field.npz`, fitted
    to all frames, and the stage "field" of the report. Returns `{"validation": {group: {"without",
    "with", "spread"}} in dB, "gain" (and its spread, None without validation), "rendered", "ridge",
    "clamped", "lights"}`, or "left_out" for the field "none", which removes an earlier one.
    """
    held_out, request = held_out or HeldOut(), request or FieldRequest()
    report = model.report()
    if request.field == "none":
        model.remove(FIELD_FILE)
        report.drop("field")
        model.write_report(report)
        return {"left_out": "the requested field is 'none'"}
    training = held_out.training(capture)
    names = training.olat_lights()
    directions = np.array([training.rig.light(name).position for name in names])
    used = [names[k] for k in far_apart(directions, request.lights)]
    fitted = FittedModel.load(model, capture, with_field=False)
    with report.stage("field") as stage:
        mapped = fitted.mapped()
        base = Rendered(
            mapped,
            mapped.scene,
            tuple(fitted.lights(used)),
            fitted.appearance.exposure.scale,
        )
        found = fit_field(training, model, base, request, progress, seed)
        stage.warnings += found.warnings
        doubts = found.doubts()
        if not doubts:
            found.field.save(model)
        stays = ", the earlier field stays" if doubts and model.has(FIELD_FILE) else ""
        for doubt in doubts:
            stage.warn(f"{request.field}, {doubt}: it is not rendered{stays}")
        result: dict[str, Any] = {
            "validation": found.validation,
            "gain": _known(found.gain),
            "rendered": not doubts,
            "field": found.field.kind,
            "ridge": found.ridge,
            "ridges": [_known(tried) for tried in found.tried],
            "clamped": found.clamped,
            "lights": len(used),
        }
        stage.figures |= {**result, "options": asdict(request)}
    model.write_report(report)
    shutil.rmtree(model.work("field"), ignore_errors=True)
    progress("field fitted", 1.0)
    return result


def _known(values: Sequence[float]) -> list[float | None]:
    """`values` for JSON, with None for infinite ones."""
    return [x if np.isfinite(x) else None for x in values]


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

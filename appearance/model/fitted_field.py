"""A field of reflectance on a model's material, kept if left-out images are better with it."""

from __future__ import annotations

import shutil
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from appearance.fields.field import FIELD_FILE
from appearance.fields.fit import NOTHING
from appearance.fields.options import FieldRequest
from appearance.fields.pipeline import Rendered, fit_field
from appearance.fields.validation import Folds
from appearance.metrics.decision import Decision
from appearance.model.fitted_model import FittedModel
from appearance.observations import HeldOut, far_apart
from reconstruction import Capture, Model, Progress, silent


def fit_field_validated(
    capture: Capture,
    model: Model,
    *,
    held_out: HeldOut | None = None,
    request: FieldRequest | None = None,
    progress: Progress = silent,
    seed: int = 0,
) -> dict[str, Any]:
    """Fit a field to the model's residual, kept by `decide` on left-out images.

    Of the lights that are not `held_out` some are used (`FieldRequest`), with directions far apart.
    Cameras and lights are left out in turn; an image decides if neither its camera nor its light
    was fitted. If the field is dropped, an earlier one stays. Writes `field.npz`, fitted to all
    frames, and the stage "field" of the report. Returns `{"stages": [decision], "rendered",
    "field", "ridge", "ridges", "clamped", "lights"}`, or "left_out" for the field "none", which
    removes an earlier one.
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
    fitted, cameras = FittedModel.load(model, capture, with_field=False), training.rig.cameras
    lights, pixels = request.resolved(len(cameras), len(fitted.strands))
    used = [names[k] for k in far_apart(directions, lights)]
    if not Folds.of(len(cameras), len(used), request.fit.folds).count:
        return {"stages": [Decision("field", skipped=NOTHING).to_dict()], "rendered": False}
    request = replace(request, lights=len(used), pixels=pixels)
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
        if found.decision.kept:
            found.field.save(model)
        result: dict[str, Any] = {
            "stages": [found.decision.to_dict()],
            "rendered": found.decision.kept,
            "field": found.field.kind,
            "ridge": found.ridge,
            "ridges": found.tried,
            "clamped": found.clamped,
            "lights": len(used),
        }
        stage.figures |= {**result, "options": asdict(request)}
    model.write_report(report)
    shutil.rmtree(model.work("field"), ignore_errors=True)
    progress(str(found.decision), 1.0)
    return result

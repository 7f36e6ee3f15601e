"""Inverse rendering of a capture: from a model's strands and masks to maps and lights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from appearance.bsdf.maps import HairMaps, MappedStrands, scalp_coordinates
from appearance.inverse_rendering.fitted_lights import LIGHTS_FILE, save_lights
from appearance.inverse_rendering.global_parameters import FOUND
from appearance.inverse_rendering.lobes import as_calibrated, mean_level, without_axis
from appearance.inverse_rendering.loop import Monitor, Outcome, run
from appearance.inverse_rendering.memory import Sizes, memory_needed
from appearance.inverse_rendering.options import InverseRenderingRequest
from appearance.inverse_rendering.problem import FitProblem
from appearance.metrics.decision import MATERIAL, Material
from appearance.observations import HeldOut, far_apart, observe_hair
from appearance.render.bounces import bounce_limit
from appearance.scene.hair_scene import build_scene
from appearance.sun_fit.fitted_appearance import FittedAppearance
from reconstruction import Capture, Light, Mesh, Model, ModelError, Progress, Stage, Strands, silent
from reconstruction.arrays import Array
from reconstruction.geometry.lights import components
from reconstruction.report.progress import part_of
from reconstruction.report.report import free_memory, resident_memory

FILES = "hair_maps.npz", LIGHTS_FILE
MOST_DEPTH = 16
FLAT = 0.7
"""Standard error over the prior's width above which the response is flat: of its square, half."""
_SHOWN = 4
"""Hair pixels of an image for each one that is fitted, at least."""
_AT_LIMIT = 1e-3
"""Relative distance from a limit of roughness at which it is reached."""
FROM_SUN = 1.15
"""Ratio to Sun's roughness, or its inverse, above which a fitted roughness is doubtful."""
BLACKER = 3.0
"""Times the start's absorption, beyond which black hair ends too rough where the index is held."""


def fit_maps(
    capture: Capture,
    model: Model,
    *,
    held_out: HeldOut | None = None,
    stages: Sequence[Material] = MATERIAL,
    request: InverseRenderingRequest | None = None,
    progress: Progress = silent,
    seed: int = 0,
) -> dict[str, Any]:
    """Fit maps and lights in `stages`, from the `appearance.json` of Sun's fit.

    Of the lights that are not `held_out`, some are fitted and others, with a camera, decide which
    stages are kept (see `loop.run`), with directions far apart. Writes `hair_maps.npz` and
    `lights.json` if one was kept, and the stage "inverse_rendering" of the report. A killed fit
    resumes from its checkpoint in the model; an earlier fit and its field stay until the fit is
    done. Returns `{"stages": [decisions], "kept", "rendered": "inverse_rendering" | "sun_fit",
    "left_open", "lights"}`. Raises `CaptureError` or `ModelError` naming what is missing.
    """
    held_out, request = held_out or HeldOut(), request or InverseRenderingRequest()
    training = held_out.training(capture)
    names = training.lightings()
    positions = np.array([training.lighting(name).position for name in names])
    held = min(request.validation_lights, len(names) // 4)
    training = training.view(lights=[names[k] for k in far_apart(positions, request.lights + held)])
    training = reduced_for_fit(training, model, request.hair_pixels)
    fitted, strands, head = FittedAppearance.load(model), model.strands(), model.head(capture)
    report = model.report()
    with report.stage("inverse_rendering") as stage:
        _check_memory(training, model, strands, request, stage, progress)
        progress("reading hair pixels", 0.0)
        rng = np.random.default_rng(seed)
        views = observe_hair(training, model, training.lightings(), request.hair_pixels, rng)
        scene = build_scene(strands, head, hair=fitted.hair, skin=fitted.skin)
        mapped = MappedStrands.of(scene, strands, root_uv(model, strands, head))
        depth = request.max_depth
        if depth is None:
            o = views[0]
            limit = bounce_limit(scene, o.camera, 0.01, pixels=o.pixels, seed=seed)
            depth = min(limit.depth, MOST_DEPTH)
        options = replace(request.fit, effort=replace(request.fit.effort, max_depth=depth))
        problem = FitProblem(mapped, views, fitted.exposure.scale, np.array(fitted.skin))
        start, checkpoint = HairMaps.of(fitted.hair), model.checkpoint("stages")
        found = run(
            problem,
            start,
            stages=stages,
            options=options,
            held_lights=held,
            monitor=Monitor(part_of(progress, 0.05, 1.0), checkpoint),
            seed=seed,
        )
        for earlier in ("field.npz", *FILES):  # a field belonged to the maps below it
            model.remove(earlier)
        if found.kept:
            found.maps.save(model, mapped.root_uv)
            if any(isinstance(x, Light) for x in problem.lights):
                write_fitted_lights(model, capture.rig.lights, problem, found)
            stage.warnings += _doubts(start, found.maps, bool(training.olat_lights())) + _flat(
                found.left_open
            )
        result: dict[str, Any] = {
            "stages": [x.to_dict() for x in found.decisions],
            "kept": found.kept,
            "rendered": "inverse_rendering" if found.kept else "sun_fit",
            "left_open": found.left_open,
            "lights": len(problem.lights) - held,
        }
        if found.lobes is not None:
            axes = _axes([x.name for x in problem.lights], found.lobes)
            result["axes"] = axes
            stage.warnings += _undetermined(axes)
        stage.figures |= {**result, "options": asdict(options), "depth": depth}
    report.drop("field")
    model.write_report(report)
    checkpoint.unlink(missing_ok=True)
    progress("inverse rendering done", 1.0)
    return result


def write_fitted_lights(
    model: Model, lights: Sequence[Light], problem: FitProblem, found: Outcome
) -> None:
    """Write the fitted lights; if axes were found, also all other `lights` without an axis, which
    are as bright on the hair as the fitted ones on average."""
    singles = [x for x in problem.lights if isinstance(x, Light)]
    gain, lobes = found.gain, found.lobes
    if lobes is not None and np.isfinite(lobes[:, 3]).any():
        names = {x.name for x in singles}
        others = [x for x in lights if x.name not in names and without_axis(x)]
        level = mean_level(problem, lobes, gain)
        gain = np.append(gain, np.full(len(others), level))
        lobes = np.vstack([lobes, as_calibrated(len(others))])
        singles += others
    save_lights(model, gain, singles, lobes)


def _doubts(start: HairMaps, found: HairMaps, measured: bool) -> list[str]:
    """Why a fitted roughness is doubtful, one sentence each; empty if it is not.

    `measured`: that of the start was.
    """
    doubts = []
    for name, (least, most) in FOUND.items():
        value, begun = (float(getattr(x, name)) for x in (found, start))
        # a start at a limit that no stage moved is none
        margin = -_AT_LIMIT if np.isclose(value, begun, rtol=_AT_LIMIT) else _AT_LIMIT
        if not (1 + margin) * least < value < (1 - margin) * most:
            doubts.append(
                f"{name} {value:.2f} is not inside {least} to {most}, the range in which it is "
                "recovered: the strands are misplaced, or the fibres' roughness lies beyond it"
            )
    before, after = (float(x.sigma_a.mean()) for x in (start, found))
    if after > max(1.0, BLACKER * before):
        doubts.append(
            f"beta_m {found.beta_m:.2f} may be too rough: the hair is black, and its fit began at "
            f"the sigma_a {before:.2g} of Sun's fit, against {after:.2g}"
        )
    if measured and not doubts and abs(np.log(found.beta_m / start.beta_m)) > np.log(FROM_SUN):
        doubts.append(
            f"beta_m {found.beta_m:.2f} differs from {start.beta_m:.2f}, measured on "
            "highlights by Sun's fit: errors of the strands' positions look like roughness"
        )
    return doubts


def _flat(left_open: Mapping[str, float]) -> list[str]:
    """Which parameters the images hardly depend on, one sentence each."""
    return [
        f"{name} is undetermined: its standard error is {open_:.0%} of the prior's width, and it "
        "stays near its start"
        for name, open_ in left_open.items()
        if open_ > FLAT
    ]


def _axes(names: Sequence[str], lobes: Array) -> dict[str, dict[str, float | None]]:
    """Axis' standard error in degrees, power and its error, of lights whose axis was fitted; the
    power is None where the axis is undetermined."""
    return {
        name: {
            "axis_error_deg": float(np.degrees(row[4])),
            "power": float(row[3]) if np.isfinite(row[3]) else None,
            "power_error": float(row[5]),
        }
        for name, row in zip(names, lobes, strict=True)
        if np.isfinite(row[4])
    }


def _undetermined(axes: Mapping[str, Mapping[str, float | None]]) -> list[str]:
    """A sentence on lights without an axis beside lights with one."""
    lost = [f"{n} ({x['axis_error_deg']:.0f}°)" for n, x in axes.items() if x["power"] is None]
    if not lost or len(lost) == len(axes):
        return []
    return [
        f"The axes of {len(lost)} of {len(axes)} lights are undetermined (standard errors: "
        f"{', '.join(lost)}). They stay as calibrated; give their aim in the rig file"
    ]


def _check_memory(
    training: Capture,
    model: Model,
    strands: Strands,
    request: InverseRenderingRequest,
    stage: Stage,
    progress: Progress,
) -> None:
    """Report the memory that the process will need; refuse if it is not available."""
    hair = [int(model.mask(c.name, "hair", training).sum()) for c in training.rig.cameras]
    pixels, lights = (
        [min(n, request.hair_pixels) for n in hair],
        len(components([training.lighting(name) for name in training.lightings()])[0]),
    )
    needed = memory_needed(Sizes(pixels, lights, len(strands.points)), request.fit)
    free = free_memory()
    stage.figures["memory_needed_gb"] = whole = (resident_memory() or 0.0) + needed
    progress(f"will take about {whole:.1f} GB of memory", 0.0)
    if free is not None and needed > free:
        raise ModelError(
            f"{model}: inverse rendering of {sum(pixels)} pixels under {lights} lights takes about "
            f"{needed:.1f} GB of memory, and {free:.1f} GB are free: lower hair_pixels, now "
            f"{request.hair_pixels}, or hold out more lights"
        )


def reduced_for_fit(training: Capture, model: Model, pixels: int) -> Capture:
    """`training`, downsampled while hair covers `_SHOWN * pixels` pixels of the largest image.

    The frames that decide are rendered whole, and strands are off by more than a fine pixel.
    """
    most = max(int(model.mask(c.name, "hair", training).sum()) for c in training.rig.cameras)
    by = int((most / (_SHOWN * pixels)) ** 0.5)
    return training.view(reduced=by * training.reduced_by) if by > 1 else training


def root_uv(model: Model, strands: Strands, head: Mesh | None) -> Array:
    """The roots' places on the scalp's map `(S, 2)`, as reconstruction left them where it did."""
    known = model.root_uv(strands)
    return scalp_coordinates(strands, head) if known is None else known

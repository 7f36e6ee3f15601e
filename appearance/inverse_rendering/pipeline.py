"""Inverse rendering of a capture: from a model's strands and masks to maps and lights."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from appearance.bsdf.maps import HairMaps, MappedStrands, scalp_coordinates
from appearance.inverse_rendering.fitted_lights import LIGHTS_FILE, fitted_lights, save_lights
from appearance.inverse_rendering.global_parameters import FOUND
from appearance.inverse_rendering.held_out import Judged, held_out_frames, judge
from appearance.inverse_rendering.loop import SURE, Monitor, Outcome, run
from appearance.inverse_rendering.memory import Sizes, memory_needed
from appearance.inverse_rendering.options import InverseRenderingOptions, InverseRenderingRequest
from appearance.inverse_rendering.problem import FitProblem
from appearance.metrics.scores import scores_unavailable
from appearance.observations import HeldOut, observe_hair
from appearance.render.bounces import bounce_limit
from appearance.render.tracing import Sampling
from appearance.scene.hair_scene import build_scene
from appearance.sun_fit.fitted_appearance import FittedAppearance
from reconstruction import Capture, Mesh, Model, ModelError, Progress, Stage, Strands, silent
from reconstruction.arrays import Array
from reconstruction.report.progress import part_of
from reconstruction.report.report import Series, free_memory, resident_memory

FILES = "hair_maps.npz", LIGHTS_FILE
JUDGED_IMAGES = 12
"""Held-out images that are judged, at most."""
MOST_DEPTH = 16
FLAT = 0.7
"""Standard error over the prior's width above which the response is flat: of its square, half."""
FROM_SUN = 1.15
"""Ratio to Sun's roughness, or its inverse, above which a fitted roughness is doubtful."""
BLACKER = 3.0
"""Times the start's absorption, beyond which black hair ends too rough where the index is held."""


def fit_maps(
    capture: Capture,
    model: Model,
    *,
    held_out: HeldOut | None = None,
    request: InverseRenderingRequest | None = None,
    progress: Progress = silent,
    seed: int = 0,
) -> dict[str, Any]:
    """Fit maps and lights, from the `appearance.json` of Sun's fit, and validate them.

    Writes `hair_maps.npz`, `lights.json`, `inverse_rendering.png` if images are held out (captured,
    rendered and error maps) and the stage "inverse_rendering" of the report. A killed fit resumes
    from its checkpoint in the model; an earlier fit and its field stay until the fit is done. If
    full training images are not clearly better with the result than with Sun's fit, it is
    discarded with a warning. Returns `{"ended", "error", "start_error", "sure", "accepted",
    "doubts", "held_out": {"start" | "inverse_rendering": {"psnr", "ssim", "relative_error"}}}`, the
    last if images are held out; see `Outcome`. "doubts" are warnings if the result is rendered.
    Raises `CaptureError` or `ModelError` naming what is missing.
    """
    held_out, request = held_out or HeldOut(), request or InverseRenderingRequest()
    training = held_out.training(capture)
    fitted, strands, head = FittedAppearance.load(model), model.strands(), model.head(capture)
    report = model.report()
    with report.stage("inverse_rendering") as stage:
        _check_memory(capture, model, strands, held_out, request, stage, progress)
        progress("reading hair pixels", 0.0)
        rng = np.random.default_rng(seed)
        views = observe_hair(training, model, training.olat_lights(), request.hair_pixels, rng)
        scene = build_scene(strands, head, hair=fitted.hair, skin=fitted.skin)
        mapped = MappedStrands.of(scene, strands, root_uv(model, strands, head))
        depth = request.max_depth
        if depth is None:
            o = views[0]
            limit = bounce_limit(scene, o.camera, 0.01, pixels=o.pixels, seed=seed)
            depth = min(limit.depth, MOST_DEPTH)
        options = replace(request.fit, effort=replace(request.fit.effort, max_depth=depth))
        problem = FitProblem(mapped, views, fitted.exposure.scale, np.array(fitted.skin))
        start = HairMaps.of(fitted.hair)
        fit = _Fit(problem, model, stage, progress, seed)
        one_colour = fit.run(replace(options, variant="original"), start, None, (0.05, 0.3))
        outcome, taken = one_colour, one_colour.error < one_colour.start_error
        if options.variant != "original":
            outcome = fit.run(options, one_colour.maps, one_colour.gain, (0.3, 0.9))
            taken = taken or outcome.error < outcome.start_error
        found = outcome if taken or outcome.rejected is None else outcome.rejected
        judged = Model(model.work("inverse_rendering")).create()
        found.maps.save(judged, mapped.root_uv)
        save_lights(judged, found.gain, problem.lights)
        progress("judging held-out images", 0.92)
        result: dict[str, Any] = {
            "ended": outcome.ended,
            "start_error": one_colour.start_error,
            "error": found.error,
            "sure": outcome.sure,
            "accepted": taken,
            "doubts": _doubts(start, found.maps) + _flat(one_colour.left_open),
            "left_open": one_colour.left_open,
        }
        frames = held_out_frames(capture, model, held_out, JUDGED_IMAGES)
        if frames:
            lights = tuple(fitted_lights(judged, capture.rig.lights))
            fits = {
                name: Judged(mapped.with_maps(maps).with_skin(fitted.skin), rig)
                for name, maps, rig in (
                    ("start", start, capture.rig),
                    ("inverse_rendering", found.maps, replace(capture.rig, lights=lights)),
                )
            }
            judging = Sampling(request.judged_spp, depth, seed)
            result["held_out"] = judge(model, frames, fits, fitted.exposure, judging)
            result |= scores_unavailable()
        for earlier in ("field.npz", *FILES):  # a field belonged to the maps below it
            model.remove(earlier)
        if taken:
            for name in FILES:
                judged.file(name).replace(model.file(name))
        stage.figures |= {**result, "options": asdict(options), "depth": depth}
    report.drop("field")
    model.write_report(report)
    shutil.rmtree(judged.path)
    for variant in ("original", options.variant):
        model.checkpoint(variant).unlink(missing_ok=True)
    progress("inverse rendering done", 1.0)
    return result


def _doubts(start: HairMaps, found: HairMaps) -> list[str]:
    """Why a fitted roughness is doubtful, one sentence each; empty if it is not."""
    doubts = [
        f"{name} {value:.2f} lies outside {least} to {most}, the range in which it was recovered"
        for name, (least, most) in FOUND.items()
        if not least <= (value := float(getattr(found, name))) <= most
    ]
    before, after = (float(x.sigma_a.mean()) for x in (start, found))
    if after > max(1.0, BLACKER * before):
        doubts.append(
            f"beta_m {found.beta_m:.2f} may be too rough: the hair is black, and its fit began at "
            f"the sigma_a {before:.2g} of Sun's fit, against {after:.2g}"
        )
    if not doubts and abs(np.log(found.beta_m / start.beta_m)) > np.log(FROM_SUN):
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


def _check_memory(
    capture: Capture,
    model: Model,
    strands: Strands,
    held_out: HeldOut,
    request: InverseRenderingRequest,
    stage: Stage,
    progress: Progress,
) -> None:
    """Report the memory that the process will need; refuse if it is not available."""
    training = held_out.training(capture)
    hair = [int(model.mask(c.name, "hair", training).sum()) for c in training.rig.cameras]
    pixels, lights = [min(n, request.hair_pixels) for n in hair], len(training.olat_lights())
    sizes = Sizes(pixels, lights, len(strands.points))
    if held_out.cameras or held_out.lights:
        frame = max(c.width * c.height for c in capture.rig.cameras)
        judged = min(len(held_out.lights) or lights, JUDGED_IMAGES)
        sizes = replace(sizes, hair=max(hair), frame=frame, judged=judged)
    needed, free = memory_needed(sizes, request.fit), free_memory()
    stage.figures["memory_needed_gb"] = whole = (resident_memory() or 0.0) + needed
    progress(f"will take about {whole:.1f} GB of memory", 0.0)
    if free is not None and needed > free:
        raise ModelError(
            f"{model}: inverse rendering of {sum(pixels)} pixels under {lights} lights takes about "
            f"{needed:.1f} GB of memory, and {free:.1f} GB are free: lower hair_pixels, now "
            f"{request.hair_pixels}, or hold out more lights"
        )


def root_uv(model: Model, strands: Strands, head: Mesh | None) -> Array:
    """The roots' places on the scalp's map `(S, 2)`, as reconstruction left them where it did."""
    known = model.root_uv(strands)
    return scalp_coordinates(strands, head) if known is None else known


@dataclass(frozen=True)
class _Fit:
    """What the fit of one colour and that of the maps share."""

    problem: FitProblem
    model: Model
    stage: Stage
    progress: Progress
    seed: int

    def run(
        self,
        options: InverseRenderingOptions,
        maps: HairMaps,
        gain: Array | None,
        share: tuple[float, float],
    ) -> Outcome:
        """Fit from `maps` and the lights' factors `gain (L,)`; `share`: part of the progress."""
        monitor = Monitor(part_of(self.progress, *share), self.model.checkpoint(options.variant))
        outcome = run(self.problem, maps, gain, options=options, monitor=monitor, seed=self.seed)
        measured = "weighted mean squared difference, noise taken off"
        series = Series(f"inverse rendering, {options.variant}", measured)
        series.points = list(outcome.history)
        self.stage.series.append(series)
        if outcome.rejected is not None:
            self.stage.warn(
                f"{options.variant}: rejected, as the loss of full training images went from "
                f"{outcome.error:.4f} to {outcome.rejected.error:.4f}, lower in {outcome.sure:.0%} "
                f"of random draws of parts of the hair ({SURE:.1%} are required)"
            )
        elif outcome.ended != "converged":
            self.stage.warn(f"{options.variant}: {outcome.ended}")
        return outcome

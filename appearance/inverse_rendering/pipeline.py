"""Stage 1 on a capture: from the model folder's strands and masks to maps and lamps."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from appearance.bsdf.maps import HairMaps, MappedStrands, scalp_coordinates
from appearance.inverse_rendering.held_out import held_out_frames, judge
from appearance.inverse_rendering.loop import Outcome, Stage1Options, run
from appearance.inverse_rendering.problem import Effort, Problem
from appearance.inverse_rendering.unknowns import Lamps
from appearance.metrics.scores import scores_unavailable
from appearance.model.fitted_appearance import FittedAppearance
from appearance.observations import HeldOut, Observed, chosen, model_mask, observe
from appearance.render.bounces import bounce_limit
from appearance.scene.hair_scene import build_scene
from reconstruction.arrays import Array
from reconstruction.capture.folder import Capture
from reconstruction.files.strands import read_strands
from reconstruction.geometry.strands import Strands
from reconstruction.report.report import Progress, Report, Series, Stage, silent

MAPS, LAMPS, PICTURE = "hair_maps.npz", "lamps.json", "stage1.png"


@dataclass(frozen=True)
class Stage1Request:
    """What a job may ask for.

    `hair_pixels` a camera are fitted, one colour before the volume. `fit` are fields of
    `Stage1Options`, of which `effort` holds fields of `Effort`. Held-out images are
    judged on at most `judged_images`, with `judged_spp` paths a pixel.
    """

    hair_pixels: int = 4000
    judged_images: int = 6
    judged_spp: int = 48
    fit: dict[str, Any] = field(default_factory=dict)

    def options(self, max_depth: int) -> Stage1Options:
        """The fit's own options; `TypeError` for fields that are unknown."""
        given = dict(self.fit)
        effort = Effort(**{"max_depth": max_depth, **given.pop("effort", {})})
        shape = tuple(given.pop("shape", Stage1Options.shape))
        return Stage1Options(effort=effort, shape=shape, **given)


def fit_stage1(
    capture: Capture,
    model: Path,
    *,
    held_out: HeldOut | None = None,
    request: Stage1Request | None = None,
    progress: Progress = silent,
    seed: int = 0,
) -> dict[str, Any]:
    """Fit maps and lamps, from the `appearance.json` of Sun's fit, and judge them.

    Reads `strands.npz`, `masks/` and `appearance.json` of the folder `model`. Writes
    `hair_maps.npz`, `lamps.json`, `stage1.png` where images are held out (captured, rendered and
    error maps) and the stage "stage1" of `report.json`; a fit that was killed goes on from its
    checkpoint, which stays in the folder until the fit is done. Returns `{"ended", "steps",
    "error", "start_error", "held_out": {"start" | "stage1": {"psnr", "ssim", "relative_error"}}}`,
    the latter where images are held out. Raises `CaptureError`,
    `FileNotFoundError` or `ValueError` naming what is missing.
    """
    held_out, request = held_out or HeldOut(), request or Stage1Request()
    held_out.check(capture)
    fitted = FittedAppearance.load(model)
    strands = read_strands(model / "strands.npz")
    report = Report.load(model / "report.json")
    with report.stage("stage1") as stage:
        progress("reading hair pixels", 0.0)
        views = _views(capture, model, held_out, request, seed)
        scene = build_scene(strands, capture.head, hair=fitted.hair, skin=fitted.skin)
        mapped = MappedStrands.of(scene, strands, _root_uv(model, strands, capture))
        depth = bounce_limit(scene, views[0].camera, 0.01, pixels=views[0].pixels, seed=seed).depth
        options = request.options(min(depth, 16))
        problem = Problem(mapped, views, fitted.exposure.scale, np.array(fitted.skin))
        start = HairMaps.of(fitted.hair)
        first = replace(options, row="original")
        outcome = _run(problem, start, None, first, model, _part(progress, 0.05, 0.3), seed, stage)
        outcome = _run(
            problem,
            outcome.maps,
            outcome.lamps,
            options,
            model,
            _part(progress, 0.3, 0.9),
            seed,
            stage,
        )
        outcome.maps.save(model / MAPS, mapped.root_uv)
        _write_lamps(model / LAMPS, outcome.lamps, problem)
        progress("judging held-out images", 0.92)
        result = {
            "ended": outcome.ended,
            "steps": outcome.steps,
            "start_error": outcome.start_error,
            "error": outcome.error,
        }
        frames = held_out_frames(capture, model, held_out, request.judged_images, seed)
        if frames:
            result["held_out"] = judge(
                model / PICTURE,
                frames,
                {
                    name: mapped.painted(maps).with_skin(fitted.skin)
                    for name, maps in (("start", start), ("stage1", outcome.maps))
                },
                fitted.exposure,
                spp=request.judged_spp,
                max_depth=options.effort.max_depth,
                seed=seed,
            )
            result |= scores_unavailable()
        stage.figures |= {**result, "options": asdict(options), "depth": depth}
    report.save(model / "report.json")
    for row in ("original", options.row):
        _checkpoint(model, row).unlink(missing_ok=True)
    progress("stage 1 done", 1.0)
    return result


def _run(
    problem: Problem,
    maps: HairMaps,
    lamps: Lamps | None,
    options: Stage1Options,
    model: Path,
    progress: Progress,
    seed: int,
    stage: Stage,
) -> Outcome:
    outcome = run(
        problem,
        maps,
        lamps,
        options=options,
        checkpoint=_checkpoint(model, options.row),
        progress=progress,
        seed=seed,
    )
    series = Series(f"stage 1, {options.row}", "weighted mean squared difference, noise taken off")
    series.points = [(seconds, error) for seconds, _, error in outcome.history]
    stage.series.append(series)
    if outcome.steps < options.steps and outcome.ended != "converged":
        stage.warn(f"{options.row}: {outcome.ended}")
    return outcome


def _root_uv(model: Path, strands: Strands, capture: Capture) -> Array:
    """The roots' places on the scalp, of `scalp_map.npz` where reconstruction left one."""
    file = model / "scalp_map.npz"
    if file.is_file():
        with np.load(file) as data:
            roots = np.asarray(data["roots"], float)
        if len(roots) == len(strands):
            return np.clip(roots, 0, 1)
    return scalp_coordinates(strands, capture.head)


def _checkpoint(model: Path, row: str) -> Path:
    return model / f"stage1-{row}.checkpoint.npz"


def _part(progress: Progress, begin: float, end: float) -> Progress:
    return lambda what, share: progress(what, begin + (end - begin) * share)


def _views(
    capture: Capture, model: Path, held_out: HeldOut, request: Stage1Request, seed: int
) -> list[Observed]:
    rng = np.random.default_rng(seed)
    lights = held_out.training_lights(capture)
    views = []
    for name in held_out.training_cameras(capture):
        pixels = chosen(model_mask(model, name, "hair", capture), request.hair_pixels, rng)
        if len(pixels):
            views.append(observe(capture, name, lights, pixels))
    if not views:
        raise ValueError(f"{model}: the hair masks of the training cameras are all empty")
    return views


def _write_lamps(path: Path, lamps: Lamps, problem: Problem) -> None:
    """The lamps as found: position and intensity, and how they differ from their calibration."""
    found = lamps.of(problem.lights)
    rows = [
        {
            **light.to_dict(),
            "moved_m": lamps.position[i].tolist(),
            "turned_rad": lamps.turn[i].tolist(),
            "gain": float(lamps.gain[i]),
            "profile_scale": float(lamps.profile[i]),
        }
        for i, light in enumerate(found)
    ]
    part = path.with_suffix(".part")
    part.write_text(json.dumps(rows, indent=1, allow_nan=False) + "\n")
    part.replace(path)

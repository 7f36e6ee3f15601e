"""The steps of pipelines.

A step reads the capture and model folders and writes its results to the model folder; its return
value is small and JSON-ready. After a crash a step runs again and writes the same files.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from reconstruction import Capture, Model, Progress
from reconstruction.capture.demultiplexing import demultiplex, determines_lights
from reconstruction.capture.records import origin
from stage_service.jobs.records import JobOptions

Figures = dict[str, Any]


@dataclass(frozen=True)
class StepContext:
    """A step's input; `previous` has the return values of the job's earlier steps, by name."""

    capture: Path
    model: Model
    options: JobOptions
    progress: Progress
    previous: Mapping[str, Figures] = field(default_factory=dict)

    def frames(self) -> Capture:
        """The capture, its images reduced as requested; of patterns that determine them, single
        lights, which are written once to the model's folder "work"."""
        shot = Capture(self.capture)
        if determines_lights(shot):
            single = self.single_lights
            if not _made_of(single, shot):
                shutil.rmtree(single, ignore_errors=True)
                demultiplex(shot, single, self.progress)
            shot = Capture(single)
        return shot.view(reduced=self.options.reduced)

    @property
    def single_lights(self) -> Path:
        """The folder of single lights made of patterns."""
        return self.model.work("single_lights")

    def for_appearance(self) -> dict[str, Any]:
        """The arguments that the appearance's fits and assessment share."""
        from appearance import HeldOut

        options = self.options
        return {
            "capture": self.frames(),
            "model": self.model,
            "held_out": HeldOut(options.held_out_cameras, options.held_out_lights),
            "progress": self.progress,
            "seed": options.seed,
        }


def _made_of(single: Path, shot: Capture) -> bool:
    """Whether `single` is whole, of this capture, and newer than its table and frames."""
    done = single / "manifest.json"
    if not done.is_file() or origin(Capture(single).plan) != origin(shot.plan):
        return False
    files = [shot.path / "plan.json", shot.path / "journal.jsonl"]
    written = max(file.stat().st_mtime_ns for file in files if file.is_file())
    return done.stat().st_mtime_ns >= written


def compress(context: StepContext) -> Figures:
    """Rewrite the capture's frames compressed, losslessly."""
    if not context.options.compress:
        return {"left_out": "switched off by the option 'compress'"}
    from reconstruction.capture.compression import compress as run

    return {"bytes_saved": run(context.capture, context.progress)}


def reconstruct(context: StepContext) -> Figures:
    """Strands from the capture: `strands.npz`, `strands.hair`, `strands.usdc`, `points.npz`."""
    from reconstruction import reconstruct as run

    job = context.options
    options = replace(job.reconstruct, held_out=job.held_out_cameras, seed=job.seed)
    capture = context.frames().without_lights(job.held_out_lights)
    run(capture, context.model, method=job.method, options=options, progress=context.progress)
    return {"strands": "strands.npz"}


def fit(context: StepContext) -> Figures:
    """Roughness and colour of hair and skin: `appearance.json`."""
    from appearance import fit as run
    from appearance.sun_fit.fitted_appearance import FittedAppearance

    given = context.for_appearance()
    if "sun" not in context.options.stages and FittedAppearance.is_of(
        context.model, given["held_out"]
    ):
        return {"left_out": "the model has a fit that did not observe the held-out frames"}
    run(**given, options=context.options.fit)
    return {"appearance": "appearance.json"}


def inverse_rendering(context: StepContext) -> Figures:
    """The hair's maps and the lights by inverse rendering: `hair_maps.npz`, `lights.json`.

    If killed, it resumes from its checkpoint.
    """
    from appearance import fit_maps as run
    from appearance.metrics.decision import MATERIAL

    stages = [name for name in MATERIAL if name in context.options.stages]
    if not stages:
        return {"left_out": "no stage of inverse rendering was requested"}
    request = context.options.inverse_rendering
    return run(**context.for_appearance(), stages=stages, request=request)


def fields(context: StepContext) -> Figures:
    """A field of reflectance on top of the material: `field.npz`.

    If killed, it resumes after the last finished view.
    """
    from appearance import fit_field_validated as run

    if "field" not in context.options.stages:
        return {"left_out": "the stage was not requested"}
    if not context.frames().olat_lights():
        return {"left_out": "a field needs images of single lights, and the capture has none"}
    return run(**context.for_appearance(), request=context.options.fields)


def relight(context: StepContext) -> Figures:
    """Relit pictures, and the model's page: the result, before it is compared with anything."""
    from appearance import relight_model as run
    from stage_service.model_page import write_page

    job = context.options
    run(
        context.frames(),
        context.model,
        environment=job.environment,
        options=job.assess,
        progress=context.progress,
        seed=job.seed,
    )
    return {"page": write_page(context.model, job.label).name}


def assess(context: StepContext) -> Figures:
    """Held-out images beside the captured ones."""
    from appearance import assess as run

    return run(**context.for_appearance(), options=context.options.assess)


def evaluate(context: StepContext) -> Figures:
    """Strands and baselines against the truth; appearance too, if the truth is a folder with it."""
    if context.options.truth is None:
        return {"left_out": "no truth was given"}
    from stage_service.jobs.evaluation import evaluate_appearance, evaluate_geometry

    truth = Path(context.options.truth)
    figures = evaluate_geometry(
        Capture(context.capture),
        context.model,
        truth / "strands.npz" if truth.is_dir() else truth,
        held_out_cameras=context.options.held_out_cameras,
        baselines=context.options.baselines,
        seed=context.options.seed,
        progress=context.progress,
    )
    appearance = truth / "appearance.json"
    if "fit" in context.previous and appearance.is_file():
        figures["appearance"] = evaluate_appearance(context.model, appearance)
    return figures


def results(context: StepContext) -> Figures:
    """Gather every figure of the job in `results.json`, draw the report's plots, write the page."""
    from reconstruction.report.plots import plot_geometry, plot_report
    from stage_service.model_page import write_page

    model = context.model
    plots, report = model.file("plots"), model.report()
    plot_report(report, plots)
    done = {step: result["figures"] for step, result in context.previous.items()}
    figures: Figures = {"stages": {k: v["seconds"] for k, v in context.previous.items()}}
    for step, name in (
        ("assess", "images"),
        ("inverse_rendering", "inverse_rendering"),
        ("fields", "field"),
    ):
        if step in done and "left_out" not in done[step]:
            figures[name] = done[step]
    if "visible" in done.get("evaluate", {}):
        geometry = dict(done["evaluate"])
        for key in ("baselines", "appearance"):
            if key in geometry:
                figures[key] = geometry.pop(key)
        figures["geometry"] = geometry
        plot_geometry({"ours": geometry, **figures["baselines"]}, model.file("plots/geometry.png"))
    if context.options.label:
        figures["label"] = context.options.label
    figures["warnings"] = [f"{s.name}: {w}" for s in report.stages for w in s.warnings]
    model.write_json("results.json", figures)
    shutil.rmtree(context.single_lights, ignore_errors=True)
    return {"results": "results.json", "page": write_page(model).name}


_ALL = (
    compress,
    reconstruct,
    fit,
    inverse_rendering,
    fields,
    relight,
    assess,
    evaluate,
    results,
)
STEPS: dict[str, Callable[[StepContext], Figures]] = {step.__name__: step for step in _ALL}

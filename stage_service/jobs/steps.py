"""The steps that pipelines are made of.

A step reads its input from the capture and model folders and leaves its results in the model
folder; what it returns is small and JSON-ready. A step that is run again from its beginning (after
a crash) writes the same files again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from reconstruction import Capture, Model, Progress
from stage_service.jobs.records import JobOptions

if TYPE_CHECKING:
    from appearance import HeldOut

Figures = dict[str, Any]


@dataclass(frozen=True)
class StepContext:
    """What a step works on; `previous` holds what the job's earlier steps returned, by name."""

    capture: Path
    model: Model
    options: JobOptions
    progress: Progress
    previous: Mapping[str, Figures] = field(default_factory=dict)


def compress(context: StepContext) -> Figures:
    """Rewrite the capture's frames compressed, losslessly."""
    if not context.options.compress:
        return {"left_out": "switched off by the option 'compress'"}
    from reconstruction.capture.compression import compress as run

    return {"bytes_saved": run(context.capture, context.progress)}


def reconstruct(context: StepContext) -> Figures:
    """Strands from the capture: `strands.npz`, `strands.hair`, `strands.usdc`, `points.npz`."""
    from reconstruction import reconstruct as run

    asked = context.options
    options = replace(asked.reconstruct, held_out=asked.held_out_cameras, seed=asked.seed)
    capture = Capture(context.capture)
    left = [name for name in capture.olat_lights() if name not in asked.held_out_lights]
    capture = capture.view(lights=left)
    run(capture, context.model, method=asked.method, options=options, progress=context.progress)
    return {"strands": "strands.npz"}


def fit(context: StepContext) -> Figures:
    """Roughness and colour of hair and skin: `appearance.json`."""
    from appearance import fit as run

    run(
        Capture(context.capture),
        context.model,
        held_out=_held_out(context.options),
        options=context.options.fit,
        progress=context.progress,
        seed=context.options.seed,
    )
    return {"appearance": "appearance.json"}


def inverse_rendering(context: StepContext) -> Figures:
    """The hair's maps and the lights by inverse rendering: `hair_maps.npz`, `lights.json`.

    The message of its progress holds the current error. Killed, it goes on from its checkpoint.
    """
    from appearance import fit_maps as run

    asked = context.options
    found = run(
        Capture(context.capture),
        context.model,
        held_out=_held_out(asked),
        request=asked.inverse_rendering,
        progress=context.progress,
        seed=asked.seed,
    )
    return {"maps": "hair_maps.npz", "lights": "lights.json", **found}


def assess(context: StepContext) -> Figures:
    """Held-out images beside the captured ones, and a relit picture."""
    from appearance import assess as run

    return run(
        Capture(context.capture),
        context.model,
        held_out=_held_out(context.options),
        environment=context.options.environment,
        options=context.options.assess,
        seed=context.options.seed,
        progress=context.progress,
    )


def evaluate(context: StepContext) -> Figures:
    """Strands against true ones, beside two baselines that use no method; appearance too, where
    the truth is a folder that has it."""
    if context.options.truth is None:
        return {"left_out": "no truth was given"}
    from stage_service.jobs.evaluation import evaluate_appearance, evaluate_geometry

    truth = Path(context.options.truth)
    figures = evaluate_geometry(
        Capture(context.capture),
        context.model,
        truth / "strands.npz" if truth.is_dir() else truth,
        held_out_cameras=context.options.held_out_cameras,
        seed=context.options.seed,
        progress=context.progress,
    )
    appearance = truth / "appearance.json"
    if "fit" in context.previous and appearance.is_file():
        figures["appearance"] = evaluate_appearance(context.model, appearance)
    return figures


def results(context: StepContext) -> Figures:
    """Gather every figure of the job in `results.json`, and draw the report's plots."""
    from reconstruction.report.plots import plot_geometry, plot_report

    model = context.model
    plots, report = model.file("plots"), model.report()
    plot_report(report, plots)
    done = {step: result["figures"] for step, result in context.previous.items()}
    figures: Figures = {"stages": {k: v["seconds"] for k, v in context.previous.items()}}
    if "assess" in done:
        figures["images"] = done["assess"]
    if "inverse_rendering" in done:
        figures["inverse_rendering"] = done["inverse_rendering"]
    if "visible" in done.get("evaluate", {}):
        geometry = dict(done["evaluate"])
        for key in ("baselines", "appearance"):
            if key in geometry:
                figures[key] = geometry.pop(key)
        figures["geometry"] = geometry
        plot_geometry({"ours": geometry, **figures["baselines"]}, plots / "geometry.png")
    figures["warnings"] = [f"{s.name}: {w}" for s in report.stages for w in s.warnings]
    model.write_json("results.json", figures)
    return {"results": "results.json"}


def _held_out(options: JobOptions) -> HeldOut:
    from appearance import HeldOut

    return HeldOut(options.held_out_cameras, options.held_out_lights)


STEPS: dict[str, Callable[[StepContext], Figures]] = {
    "compress": compress,
    "reconstruct": reconstruct,
    "fit": fit,
    "inverse_rendering": inverse_rendering,
    "assess": assess,
    "evaluate": evaluate,
    "results": results,
}

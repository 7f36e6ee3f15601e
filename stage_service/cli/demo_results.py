"""What the demo found: every figure in one dictionary, and the table of them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from appearance.model.fitted_appearance import FittedAppearance
from appearance.scene.hair_appearance import HairAppearance
from appearance.sun_fit.longitudinal import colour_of_absorption, variance_of_roughness
from reconstruction.capture.folder import Capture
from reconstruction.report.plots import plot_geometry
from reconstruction.report.report import Progress
from stage_service.jobs.geometry import evaluate_geometry

GROUPS = ("held_out_lights", "held_out_camera")

FILES = {
    "strands": ("strands.npz", "strands.hair", "strands.usdc"),
    "appearance": ("appearance.json",),
    "report": ("report.json",),
}


def gather(
    out: Path,
    capture: dict[str, Any],
    job: dict[str, Any],
    progress: Progress,
) -> dict[str, Any]:
    """Judge the model against the simulated truth and gather the job's own figures."""
    model = out / "model"
    geometry = evaluate_geometry(
        Capture(out / "capture"),
        model,
        out / "truth" / "strands.npz",
        held_out_cameras=job["options"]["held_out_cameras"],
        progress=progress,
    )
    baselines = geometry.pop("baselines")
    plot_geometry({"ours": geometry, **baselines}, model / "plots" / "geometry.png")
    results = json.loads((model / "results.json").read_text())
    return {
        "capture": {
            key: capture[key]
            for key in ("id", "seconds", "frames_planned", "frames_written", "frames_missing")
        },
        "job": job["id"],
        "stages": results["stages"],
        "geometry": geometry,
        "baselines": baselines,
        "images": {k: v for k, v in results["images"].items() if k in GROUPS},
        "appearance": _appearance(model, out / "truth" / "appearance.json"),
        "files": {
            "capture": "capture",
            "model": "model",
            "pictures": sorted(str(p.relative_to(out)) for p in model.glob("*.png")),
            **{k: [f"model/{n}" for n in names] for k, names in FILES.items()},
        },
    }


def _appearance(model: Path, truth: Path) -> dict[str, Any]:
    """Roughness and colour, fitted beside true; colours as dense hair's albedo (Sun Eq. 11).

    Absorptions are compared as albedos because the fit holds beta_n at Sun's value: the same
    absorption means another colour under another beta_n.
    """
    true = json.loads(truth.read_text())
    fitted = FittedAppearance.load(model)
    return {
        "fitted": {**_hair(fitted.hair), "skin": list(fitted.skin)},
        "true": {**_hair(HairAppearance.from_dict(true["hair"])), "skin": list(true["skin"])},
    }


def _hair(hair: HairAppearance) -> dict[str, Any]:
    return {
        "beta_m": hair.beta_m,
        "v": float(variance_of_roughness(hair.beta_m)),
        "beta_n": hair.beta_n,
        "sigma_a": list(hair.sigma_a),
        "colour": [float(c) for c in colour_of_absorption(hair.sigma_a, hair.beta_n)],
    }


def figures_table(results: dict[str, Any], out: Path) -> Any:
    """The table of figures, and where the results are."""
    from rich.console import Group
    from rich.table import Table

    from stage_service.cli.evaluate import geometry_table

    geometry = geometry_table({"ours": results["geometry"], **results["baselines"]})
    images = Table("pictures (PSNR dB / SSIM)", "held-out lights", "held-out camera")
    for name in results["images"][GROUPS[0]]:
        scores = [results["images"][group][name] for group in GROUPS]
        images.add_row(name, *(f"{s['psnr']:.2f} / {s['ssim']:.4f}" for s in scores))
    fitted, true = results["appearance"]["fitted"], results["appearance"]["true"]
    hair = Table("appearance", "fitted", "true")
    for key, what in (
        ("beta_m", "longitudinal roughness β_M"),
        ("v", "longitudinal variance v (Sun's β_l)"),
        ("colour", "colour of dense hair"),
        ("skin", "colour of skin"),
    ):
        hair.add_row(what, _numbers(fitted[key]), _numbers(true[key]))
    capture = results["capture"]
    return Group(
        geometry,
        images,
        hair,
        f"{results['seconds']:.0f} s in all: capture {capture['seconds']:.0f} s, "
        + ", ".join(f"{k} {v:.0f} s" for k, v in results["stages"].items()),
        f"everything is in {out}: results.json, capture/, model/ (strands, appearance, pictures, "
        "report.json, plots/), truth/, logs/",
    )


def _numbers(value: Any) -> str:
    values = value if isinstance(value, list) else [value]
    return ", ".join(f"{x:.3g}" for x in values)

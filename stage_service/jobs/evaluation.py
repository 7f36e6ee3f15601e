"""A model against ground truth: its strands, with baselines, and its appearance."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from reconstruction import Capture, Model, Progress, Strands, silent


def evaluate_geometry(
    capture: Capture,
    model: Model,
    truth: Path,
    *,
    held_out_cameras: Sequence[str] = (),
    baselines: bool = True,
    seed: int = 0,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Score `model`'s strands and, with `baselines`, those against the strand file `truth`.

    Returns `{visible, all}` of the strands and the same of `baselines.{true_directions,
    hull_vertical, hull_smooth_field}`. The true strands are posed as during the OLAT pass. The
    hulls use the masks of the cameras that are not held out, as the reconstruction does.
    `true_directions` are our strands with the true directions over a pixel.
    """
    from reconstruction import read_strands
    from reconstruction.evaluation.assessment import true_direction_figures
    from reconstruction.evaluation.baselines import (
        baseline_hull,
        hull_smooth_field,
        hull_vertical,
    )
    from reconstruction.evaluation.matching import compare_strands
    from reconstruction.evaluation.visibility import Visibility

    true = read_strands(truth, frame=model.frame)
    cameras, head = capture.rig.cameras, model.head(capture)
    progress("what the cameras see of the true strands", 0.0)
    visibility = Visibility(cameras, true, head)

    def score(strands: Strands) -> dict[str, Any]:
        return compare_strands(strands, true, seed=seed, visibility=visibility)

    progress("our strands against the true ones", 0.02)
    ours = model.strands()
    figures = score(ours)
    if not baselines:
        progress("judged", 1.0)
        return {**figures, "baselines": {}}
    progress("our strands with the true directions over a pixel", 0.15)
    used = [c for c in cameras if c.name not in held_out_cameras]
    turned = true_direction_figures(ours, true, used, visibility=visibility, seed=seed)
    found = {"true_directions": turned}
    progress("baseline: the hull filled with vertical lines", 0.5)
    masks = {c.name: model.mask(c.name, "hair", capture) for c in used}
    hull = baseline_hull(used, masks, head)
    found["hull_vertical"] = score(hull_vertical(hull))
    progress("baseline: the hull filled with the smooth field of its surface", 0.72)
    found["hull_smooth_field"] = score(hull_smooth_field(hull, head))
    progress("judged", 1.0)
    return {**figures, "baselines": found}


def evaluate_appearance(model: Model, truth: Path) -> dict[str, Any]:
    """`model`'s roughness and colours (`fitted`) beside those of the JSON file `truth` (`true`).

    `fitted` is the rendered appearance; after inverse rendering both fits are listed as well
    (`sun_fit`, `inverse_rendering`). The colour of maps is the mean over their cells. Sun's fit has
    the 95 % interval of its roughness, `beta_m_interval`, and standard errors of logarithms,
    `beta_m_error` and `sigma_a_error (3,)`, None in an undetermined channel. Absorptions are
    compared as the albedo of dense hair (Sun 2021, Eq. 11), because the fit fixes beta_n.
    """
    from appearance import HairAppearance
    from appearance.bsdf.longitudinal import colour_of_absorption, variance_of_roughness
    from appearance.bsdf.maps import HairMaps
    from appearance.sun_fit.fitted_appearance import FittedAppearance

    def figures(maps: HairMaps, skin: Sequence[float]) -> dict[str, Any]:
        cells = colour_of_absorption(maps.sigma_a.reshape(-1, 3), maps.beta_n)
        return {
            "beta_m": maps.beta_m,
            "v": float(variance_of_roughness(maps.beta_m)),
            "beta_n": maps.beta_n,
            "sigma_a": list(maps.mean().sigma_a),
            "colour": [float(c) for c in cells.mean(axis=0)],
            "skin": list(skin),
        }

    sun, true = FittedAppearance.load(model), json.loads(truth.read_text())
    out = {"fitted": figures(HairMaps.of(sun.hair), sun.skin)}
    if sun.beta_m_interval is not None:
        out["fitted"]["beta_m_error"] = sun.beta_m_error
        out["fitted"]["beta_m_interval"] = list(sun.beta_m_interval)
    if sun.sigma_a_error is not None:
        out["fitted"]["sigma_a_error"] = list(sun.sigma_a_error)
    if model.has("hair_maps.npz"):
        out["sun_fit"] = out["fitted"]
        out["fitted"] = out["inverse_rendering"] = figures(HairMaps.load(model)[0], sun.skin)
    hair, each = HairAppearance.from_dict(true["hair"]), truth.parent / "absorption.npy"
    maps = HairMaps.each(hair, np.load(each)) if each.is_file() else HairMaps.of(hair)
    out["true"] = figures(maps, true["skin"])
    return out

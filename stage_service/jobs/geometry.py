"""Reconstructed strands against true ones, beside the baselines that use no method."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from reconstruction.capture.folder import Capture
from reconstruction.geometry.strands import Strands
from reconstruction.report.report import Progress, silent


def evaluate_geometry(
    capture: Capture,
    model: Path,
    truth: Path,
    *,
    held_out_cameras: Sequence[str] = (),
    seed: int = 0,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Score `model`'s strands and both hull baselines against the strand file `truth`.

    Returns `{visible, all}` of ours, and `baselines.{hull_vertical, hull_smooth_field}` of the same
    two. The true strands stand where the subject stood during the OLAT pass. The baselines get the
    masks that the reconstruction had: those of the cameras that are not held out.
    """
    from appearance.observations import model_mask
    from reconstruction.evaluation.baselines import baseline_hull, hull_smooth_field, hull_vertical
    from reconstruction.evaluation.matching import compare_strands
    from reconstruction.evaluation.visibility import Visibility
    from reconstruction.files.strands import read_strands
    from reconstruction.model import Model

    true = read_strands(truth)
    cameras, head = capture.rig.cameras, Model(model).head(capture)
    progress("what the cameras see of the true strands", 0.0)
    visibility = Visibility(cameras, true, head)

    def score(strands: Strands) -> dict[str, Any]:
        return compare_strands(
            strands, true, cameras=cameras, head=head, seed=seed, visibility=visibility
        )

    progress("our strands against the true ones", 0.2)
    figures = score(read_strands(model / "strands.npz"))
    progress("baseline: the hull filled with vertical lines", 0.3)
    used = [c for c in cameras if c.name not in held_out_cameras]
    masks = {c.name: model_mask(model, c.name, "hair", capture) for c in used}
    hull = baseline_hull(used, masks, head)
    baselines = {"hull_vertical": score(hull_vertical(hull))}
    progress("baseline: the hull filled with the smooth field of its surface", 0.6)
    baselines["hull_smooth_field"] = score(hull_smooth_field(hull, head))
    progress("judged", 1.0)
    return {**figures, "baselines": baselines}

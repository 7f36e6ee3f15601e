"""Reconstructed strands against true ones, beside the controls that use no method."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from reconstruction.capture import Capture
from reconstruction.report import Progress, silent


def evaluate_geometry(
    capture: Capture, model: Path, truth: Path, *, seed: int = 0, progress: Progress = silent
) -> dict[str, Any]:
    """Score `model`'s strands and both hull controls against the strand file `truth`.

    Returns `{visible, all}` of ours and `controls.{hull_vertical, hull_smooth_field}` with the same
    two. The true strands stand where the subject stood during the OLAT pass.
    """
    from reconstruction.controls import hull_smooth_field, hull_vertical
    from reconstruction.evaluation import compare_strands
    from reconstruction.strand_files import read_strands

    true = read_strands(truth)
    cameras, head = capture.rig.cameras, capture.head

    def score(strands: Any) -> dict[str, Any]:
        return compare_strands(strands, true, cameras=cameras, head=head, seed=seed)

    progress("our strands against the true ones", 0.0)
    figures = score(read_strands(model / "strands.npz"))
    controls = {}
    for i, control in enumerate((hull_vertical, hull_smooth_field)):
        name = control.__name__
        progress(f"control: {name}", (i + 1) / 3)
        controls[name] = score(control(capture, model))
    return {**figures, "controls": controls}

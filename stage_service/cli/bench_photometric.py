"""`bench photometric`: line stereo on patches of two heads, beside the controls and the paper."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from reconstruction.bench_light_codes import quick, run_patch
from reconstruction.pipeline import ReconstructOptions
from reconstruction.report import Progress, silent
from stage_service.cli.bench_photometric_rig import TARGETS, patch
from stage_service.cli.evaluate import geometry_table


def run(
    out: Path,
    data: Path | None,
    cache: Path,
    only: str | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Every patch of `TARGETS`, or `only` one; Sintel's needs `data`, which has her strands.

    Captures are simulated through the wires once and kept in `cache`. Leaves
    `OUT/<subject>/patch.json` and the models beside it.
    """
    from rich.console import Console

    results: dict[str, Any] = {}
    for name in TARGETS if only is None else [only]:
        if name == "sintel" and data is None:
            results[name] = {"left_out": "no folder of data was named that holds Sintel's strands"}
            continue
        here = patch(name, data or Path())
        capture, truth = here.capture.make(cache, progress)
        results[name] = run_patch(
            out / name,
            capture,
            truth,
            here.center,
            here.radius,
            options=quick(ReconstructOptions()),
            progress=progress,
        )
        Console(stderr=True).print(geometry_table(results[name]["rows"]))
    return results

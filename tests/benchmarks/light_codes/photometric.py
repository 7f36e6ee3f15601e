"""`bench photometric`: line stereo on patches of two heads, and on pictures that are not ours."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from benchmarks.light_codes.patches import quick, run_imported, run_patch
from benchmarks.light_codes.rig import TARGETS, patch
from reconstruction.pipeline import ReconstructOptions
from reconstruction.report.report import Progress, silent
from stage_service.cli.support.tables import geometry_table


def run(
    out: Path,
    data: Path | None,
    cache: Path,
    only: str | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Every patch of `TARGETS`, or `only` one; Sintel's needs `data`, which has her strands.

    Captures are simulated through the wires once and kept in `cache`. Fewer cameras and lights and
    error against run time are Sintel's alone. Leaves `OUT/<subject>/patch.json` and the models
    beside it. Without `only`, also the capture that Cycles rendered, through `import`.
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
            thinner=name == "sintel",
            progress=progress,
        )
        Console(stderr=True).print(geometry_table(results[name]["rows"]))
    if only is None and data is not None:
        results["imported"] = run_imported(
            out / "imported",
            data / "captures" / "cycles_wavy",
            options=quick(ReconstructOptions()),
            progress=progress,
        )
        Console(stderr=True).print(geometry_table(results["imported"]["rows"]))
    return results

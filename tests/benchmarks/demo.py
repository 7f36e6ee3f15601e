"""The demo's figures over subjects and seeds, from the `results.json` of runs that were made."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from benchmarks.command import Benchmark, LeftOut, option
from benchmarks.results import save
from reconstruction import Progress
from stage_service.cli.model.evaluate import demo_columns
from stage_service.cli.support.tables import figures_of, markdown_table


def _bench(args: argparse.Namespace, _progress: Progress) -> dict[str, Any]:
    paths = args.results or sorted(Path("runs").glob("*/results.json"))
    if not paths:
        raise LeftOut("no runs/*/results.json: run 'hairstage demo --out runs/NAME' first")
    columns = demo_columns(paths)
    (args.out / "demo.md").write_text(markdown_table(columns, short=False))
    result = {
        "seeds": sorted({r["seed"] for results in columns.values() for r in results}),
        "figures": {name: figures_of(results) for name, results in columns.items()},
    }
    save(args.out / "demo.json", result)
    return result


RESULTS = option("--results", "of demos; default: runs/*/results.json", type=Path, nargs="+")
BENCHMARK = Benchmark(_bench, (RESULTS,))

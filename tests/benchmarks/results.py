"""How benchmarks leave their results: JSON as it comes, tables in Markdown, curves."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from reconstruction.files.durable import write_whole


def save(path: Path, results: Mapping[str, Any]) -> None:
    """Write what there is so far as JSON: a benchmark of an hour may be interrupted."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, (json.dumps(results, indent=1, allow_nan=False) + "\n").encode())


def markdown(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(map(str, line))} |\n" for line in lines)


def spread(values: Sequence[float]) -> dict[str, float]:
    """Mean over seeds, their standard deviation (absent for one seed) and number."""
    found = {"mean": float(np.mean(values)), "seeds": len(values)}
    return found | ({"sd": float(np.std(values, ddof=1))} if len(values) > 1 else {})


Point = tuple[float, ...]
"""x, y and, where known, y's standard error."""


@dataclass(frozen=True)
class Panel:
    """Curves on common axes; run time on a logarithmic axis beside an error on another, usually."""

    title: str
    curves: Mapping[str, Sequence[Point]]
    x: str = "CPU seconds"
    y: str = "relative MSE"
    scales: tuple[str, str] = ("log", "log")
    styles: Mapping[str, str] = field(default_factory=dict)


def draw_panels(path: Path, rows: Sequence[Sequence[Panel]]) -> None:
    """Draw rows of panels as a PNG; the first panel has the legend."""
    figure = new_figure(len(rows[0]), len(rows), (3.6, 3.1))
    grid = figure.subplots(len(rows), len(rows[0]), squeeze=False)
    for line, panels in zip(grid, rows, strict=True):
        for axes, panel in zip(line, panels, strict=True):
            for name, points in panel.curves.items():
                x, y, *error = np.array(points, float).T
                style = panel.styles.get(name, "o-")
                axes.errorbar(x, y, error[0] if error else None, fmt=style, label=name)
            axes.set(xscale=panel.scales[0], yscale=panel.scales[1])
            if panel.scales[1] == "linear" and min(axes.get_ylim()) > 0:
                axes.set_ylim(bottom=0)
            axes.set_title(panel.title, fontsize=9)
            axes.set_xlabel(panel.x, fontsize=8)
            axes.set_ylabel(panel.y, fontsize=8)
            axes.tick_params(which="both", labelsize=6)
            axes.grid(True, which="major", alpha=0.3)
    grid[0][0].legend(fontsize=7)
    figure.savefig(path, dpi=90)


def new_figure(columns: int, rows: int = 1, panel: tuple[float, float] = (3.6, 3.9)) -> Figure:
    """An empty figure for `columns` x `rows` panels of so many inches, that needs no display."""
    figure = Figure(figsize=(panel[0] * columns, panel[1] * rows), layout="constrained")
    FigureCanvasAgg(figure)
    return figure

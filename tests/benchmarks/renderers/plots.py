"""Plots of the renderers' benchmark."""

from __future__ import annotations

from pathlib import Path
from typing import Any

_STYLES = {"mitsuba path": "k.-", "ours": "C0o-", "ours projected": "C1s-"}


def plot_errors(path: Path, result: dict[str, Any]) -> None:
    """Error against CPU time: a row of plots for each subject, a column for each light count."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    subjects = result["subjects"]
    columns = len(next(iter(subjects.values()))["lights"])
    figure = Figure(figsize=(3.6 * columns, 3.1 * len(subjects)), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(subjects), columns, squeeze=False)
    for line, (name, subject) in zip(grid, subjects.items(), strict=True):
        for axes, (count, entry) in zip(line, subject["lights"].items(), strict=True):
            for method, style in _STYLES.items():
                points = [p for p in entry["series"] if p["method"] == method]
                axes.loglog(
                    [p["cpu_seconds"] for p in points],
                    [p["rel_mse"] for p in points],
                    style,
                    label=method,
                )
            axes.set_title(f"{name}, {count} lights", fontsize=9)
            axes.set_xlabel("CPU seconds", fontsize=8)
            axes.set_ylabel("relative MSE", fontsize=8)
            axes.tick_params(which="both", labelsize=6)
            axes.grid(True, which="major", alpha=0.3)
    grid[0][0].legend(fontsize=7)
    figure.savefig(path, dpi=90)


def plot_growth(path: Path, result: dict[str, Any]) -> None:
    """CPU time of a path over strands, bounces and pixels, and over lights per light."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    growth = result["growth"]
    figure = Figure(figsize=(12, 3), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(1, 4)
    for axes, what in zip(grid, ("strands", "bounces", "pixels"), strict=False):
        x = [int(n) for n in growth[what]]
        axes.semilogx(x, [p["us_per_path"] for p in growth[what].values()], "C0o-")
        axes.set_xticks(x, [f"{n:,}" for n in x], fontsize=7)
        axes.minorticks_off()
        axes.set_xlabel(what)
        axes.set_ylabel(f"µs a path, {growth['lights']} lights")
        axes.set_ylim(bottom=0)
    for name, subject in result["subjects"].items():
        cost = {
            int(count): next(
                p["cpu_seconds"] / p["spp"]
                for p in reversed(entry["series"])
                if p["method"] == "ours"
            )
            for count, entry in subject["lights"].items()
        }
        per = [1e6 * c / subject["pixels"] for c in cost.values()]
        grid[3].loglog(list(cost), per, "o-", label=name)
    grid[3].set_xlabel("lights")
    grid[3].set_ylabel("µs a path")
    grid[3].legend(fontsize=7)
    for axes in grid:
        axes.grid(True, alpha=0.3)
    figure.savefig(path, dpi=90)

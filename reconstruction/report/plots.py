"""Plots of a report: time per stage, error against run time, scores of strands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from reconstruction.files.durable import writing
from reconstruction.report.report import Report, Series, Stage

INK, QUIET, FAINT = "#22262b", "#6b737c", "#d9dde1"
COLOURS = ("#0f6e84", "#d1603d", "#7a9a3a", "#7d5ba6", "#c39a1c", "#4a7fc1", "#a34a6a")
WIDTH = 9.0


def plot_report(report: Report, folder: str | Path) -> list[Path]:
    """Draw a report into PNGs in `folder` and return their paths.

    `seconds.png` (time per stage) and `error_<stage>.png` for each stage that recorded error
    against run time.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    figures: dict[str, Figure] = {}
    if report.stages:
        figures["seconds"] = _seconds(report.stages)
    for stage in report.stages:
        drawn = [s for s in stage.series if any(e > 0 for _, e in s.points)]
        if drawn:
            slug = "".join(c if c.isalnum() else "_" for c in stage.name.lower())
            figures[f"error_{slug}"] = _errors(stage.name, drawn)
    return [save_figure(figure, folder / f"{name}.png") for name, figure in figures.items()]


def plot_geometry(results: Mapping[str, Mapping[str, Any]], path: str | Path) -> Path:
    """Bars of precision, recall and F by threshold, one row each for visible and all points.

    `results` maps names ("ours", "hull_vertical", ...) to results of `compare_strands`; the first
    is emphasised.
    """
    if not results:
        raise ValueError("no results to draw")
    first = next(iter(results.values()))
    parts = [p for p in ("visible", "all") if p in first]
    measures = ("precision", "recall", "f")
    figure = Figure(figsize=(WIDTH, 0.9 + 2.5 * len(parts)), layout="constrained")
    grid = figure.subplots(len(parts), 3, sharey=True, squeeze=False)
    width = 0.8 / len(results)
    for r, (row, part) in enumerate(zip(grid, parts, strict=True)):
        for axes, measure in zip(row, measures, strict=True):
            names = list(first[part])
            for k, (name, scores) in enumerate(results.items()):
                values = [scores[part][t][measure] for t in names]
                x = np.arange(len(names)) + (k - (len(results) - 1) / 2) * width
                colour = COLOURS[0] if k == 0 else ("#a9b1b8", "#ccd2d6", FAINT)[(k - 1) % 3]
                axes.bar(x, values, 0.9 * width, color=colour, label=_words(name))
                style = {"ha": "center", "fontsize": 7, "color": INK if k == 0 else QUIET}
                for xi, v in zip(x, values, strict=True):
                    _note(axes, f"{100 * v:.0f}", (xi, v), (0, 2), style)
            axes.set_xticks(range(len(names)), [_threshold(t) for t in names])
            axes.set_ylim(0, 1.08)
            axes.set_yticks([0, 0.5, 1], ["0", "50 %", "100 %"])
            clean_axes(axes, grid_axis="y")
            if r == 0:
                axes.set_title("F" if measure == "f" else measure.capitalize(), **TITLE)
        row[0].set_ylabel(f"{part} strands", color=INK)
    handles, labels = grid[0][0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower center", ncols=len(results), frameon=False, fontsize=9
    )
    return save_figure(figure, Path(path))


_BOLD: dict[str, Any] = {"fontweight": "bold", "color": INK}
TITLE: dict[str, Any] = {"loc": "left", "fontsize": 11, **_BOLD}


def _seconds(stages: Sequence[Stage]) -> Figure:
    figure = Figure(figsize=(WIDTH, 1.0 + 0.36 * len(stages)), layout="constrained")
    axes = figure.subplots()
    seconds = np.array([s.seconds for s in stages])
    rows = np.arange(len(stages))[::-1]
    axes.barh(rows, seconds, 0.62, color=COLOURS[0])
    total = max(float(seconds.sum()), 1e-9)
    for y, s in zip(rows, seconds, strict=True):
        style = {"va": "center", "fontsize": 8.5, "color": QUIET}
        _note(axes, f"{_duration(s)}   {100 * s / total:.0f} %", (s, y), (5, 0), style)
    axes.set_yticks(rows, [_words(s.name) for s in stages])
    axes.set_xlim(0, 1.18 * max(float(seconds.max()), 1e-9))
    axes.set_xlabel("seconds", color=QUIET)
    axes.set_title(f"Time per stage, {_duration(total)} in all", **TITLE)
    clean_axes(axes, grid_axis="x")
    axes.tick_params(axis="y", colors=INK)
    return figure


def _errors(stage: str, series: Sequence[Series]) -> Figure:
    kinds = list(dict.fromkeys(s.error for s in series))
    columns = min(2, len(kinds))
    rows = -(-len(kinds) // columns)
    figure = Figure(figsize=(WIDTH, 0.4 + 3.4 * rows), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes, kind in zip(grid, kinds, strict=False):
        members = [s for s in series if s.error == kind]
        # zero seconds are drawn at the left end of the logarithmic axis
        start = 0.5 * min((t for s in members for t, _ in s.points if t > 0), default=2e-3)
        for k, s in enumerate(members):
            points = np.array([p for p in s.points if p[1] > 0], float).reshape(-1, 2)
            seconds = np.where(points[:, 0] > 0, points[:, 0], start)
            colour = COLOURS[k % len(COLOURS)]
            line = {"color": colour, "linewidth": 1.8, "label": _words(s.name)}
            if len(points) <= 25:
                line |= {"marker": "o", "ms": 4.5, "mec": "white", "mew": 0.6}
            axes.plot(seconds, points[:, 1], **line)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xlabel("seconds", color=QUIET)
        axes.set_ylabel(_words(kind), color=QUIET)
        clean_axes(axes, grid_axis="both")
        axes.legend(frameon=False, fontsize=9, labelcolor=INK)
    for axes in grid[len(kinds) :]:
        axes.remove()
    title = f"{_words(stage)}: error against run time"
    figure.suptitle(title, x=0.01, ha="left", fontsize=11, **_BOLD)
    return figure


def clean_axes(axes: Axes, grid_axis: Any) -> None:
    """Remove spines and ticks; faint grid lines across `grid_axis` (x, y or both)."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(FAINT)
    axes.tick_params(colors=QUIET, labelsize=9, length=0, which="both")
    axes.grid(axis=grid_axis, color=FAINT, linewidth=0.7, alpha=0.7)
    axes.set_axisbelow(True)


def _note(axes: Axes, text: str, at: Any, offset: tuple[int, int], style: dict[str, Any]) -> None:
    axes.annotate(text, at, offset, textcoords="offset points", **style)


def _threshold(name: str) -> str:
    """`1mm_10deg` for display."""
    return name.replace("mm_", " mm\n").replace("deg", "°")


def _words(name: str) -> str:
    return name.replace("_", " ")


def _duration(seconds: float) -> str:
    if seconds >= 120:
        return f"{int(seconds // 60)} min {int(seconds % 60)} s"
    return f"{seconds:.0f} s" if seconds >= 10 else f"{seconds:.2g} s"


def save_figure(figure: Figure, path: Path) -> Path:
    """Write a PNG atomically and return its path."""
    FigureCanvasAgg(figure)
    with writing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=130, facecolor="white")
    return path

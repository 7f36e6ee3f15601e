"""Pictures of how strands differ from the true ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure

from reconstruction.arrays import AnyFloats
from reconstruction.evaluation.assessment import Assessment, Nearest
from reconstruction.evaluation.oriented_points import THRESHOLDS
from reconstruction.report.plots import COLOURS, INK, QUIET, TITLE, WIDTH, clean_axes, save_figure

VIEWS = {
    "front": ((1, 0, 0), (0, 0, 1)),
    "left side": ((0, 1, 0), (0, 0, 1)),
    "back": ((-1, 0, 0), (0, 0, 1)),
    "right side": ((0, -1, 0), (0, 0, 1)),
    "top": ((1, 0, 0), (0, 1, 0)),
}
"""What points right and what points up in each picture; it is looked at against their product."""

STEPS_MM = (0.0, 1.0, 2.0, 3.0, 5.0)
STEPS_DEG = (0.0, 10.0, 20.0, 30.0, 45.0)
GOOD_TO_BAD = ("#0f6e84", "#74b3a2", "#e6c34e", "#dd7438", "#84202f")


def draw_errors(assessment: Assessment, folder: str | Path) -> list[Path]:
    """Write PNGs into `folder` and return their paths.

    `distance.png`, `angle.png`: the points that were scored, from five sides without perspective
    (only the nearer half of them), coloured by how far the nearest point of the other set is and by
    the angle to it. Above are the predicted ones, which are wrong where they are red, below the
    true ones, which are missing there. `regions.png`: precision, recall and F by part of the hair.
    `lengths.png`: strand lengths.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    sets = {"predicted": assessment.pred, "true": assessment.true}
    distances = {name: (s, 1e3 * s.distance) for name, s in sets.items()}
    angles = {name: (s, s.angle_deg) for name, s in sets.items()}
    pictures = {
        "distance": _views(
            distances, STEPS_MM, "millimetres to the nearest point of the other set"
        ),
        "angle": _views(angles, STEPS_DEG, "degrees between the tangents there"),
        "regions": _regions(assessment.figures["regions"]),
        "lengths": _lengths(assessment),
    }
    return [save_figure(figure, folder / f"{name}.png") for name, figure in pictures.items()]


def _views(
    sets: Mapping[str, tuple[Nearest, AnyFloats]], steps: Sequence[float], label: str
) -> Figure:
    figure = Figure(figsize=(1.5 * WIDTH, 0.58 * WIDTH), layout="constrained")
    grid = figure.subplots(len(sets), len(VIEWS), squeeze=False)
    colours = ListedColormap(list(GOOD_TO_BAD[:-1])).with_extremes(over=GOOD_TO_BAD[-1])
    norm = BoundaryNorm(list(steps), colours.N)
    low, high = np.percentile(sets["true"][0].drawn.points, (0.1, 99.9), axis=0)
    middle, half = (low + high) / 2, 0.55 * max(float((high - low).max()), 1e-3)
    for row, (name, (nearest, values)) in zip(grid, sets.items(), strict=True):
        points = (nearest.drawn.points - middle) / half
        for axes, (view, (right, up)) in zip(row, VIEWS.items(), strict=True):
            towards = points @ np.cross(right, up)
            order = np.argsort(towards)  # what is nearer hides what is behind it
            order = order[towards[order] > 0]
            x, y, colour = points[order] @ right, points[order] @ up, values[order]
            colour = np.minimum(colour, 2 * steps[-1])
            shown = axes.scatter(x, y, 2.0, colour, cmap=colours, norm=norm, linewidths=0)
            axes.set(xlim=(-1, 1), ylim=(-1, 1), xticks=[], yticks=[], aspect="equal")
            axes.spines[:].set_visible(False)
            if name == next(iter(sets)):
                axes.set_title(view, **TITLE)
        row[0].set_ylabel(f"{name} points", color=INK)
    bar = figure.colorbar(shown, ax=grid, extend="max", shrink=0.5, aspect=30)
    bar.set_label(label, color=QUIET)
    bar.outline.set_visible(False)
    return figure


def _regions(regions: Mapping[str, Mapping[str, Any]]) -> Figure:
    rows = [(name, scores) for kind in regions.values() for name, scores in kind.items()]
    figure = Figure(figsize=(WIDTH, 1.2 + 0.42 * len(rows)), layout="constrained")
    y = np.arange(len(rows))[::-1]
    marks = (("precision", ">", COLOURS[1]), ("recall", "<", COLOURS[2]))
    every = figure.subplots(1, len(THRESHOLDS), sharey=True)
    for axes, threshold in zip(every, THRESHOLDS, strict=True):
        scores = [s[threshold.name] for _, s in rows]
        axes.barh(y, [s["f"] for s in scores], 0.6, color="#cfdfe3", label="F")
        for measure, marker, colour in marks:
            x = [s[measure] for s in scores]
            axes.plot(x, y, marker, color=colour, markersize=6, label=measure)
        for yi, s in zip(y, scores, strict=True):
            axes.annotate(f"{100 * s['f']:.0f}", (0.02, yi), va="center", fontsize=8, color=INK)
        axes.set_yticks(y, [name for name, _ in rows])
        axes.set_xlim(0, 1.02)
        axes.set_xticks([0, 0.5, 1], ["0", "50 %", "100 %"])
        axes.set_title(f"{1e3 * threshold.distance:g} mm, {threshold.angle:g}°", **TITLE)
        clean_axes(axes, grid_axis="x")
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    return figure


def _lengths(assessment: Assessment) -> Figure:
    figure = Figure(figsize=(WIDTH, 3.2), layout="constrained")
    axes = figure.subplots()
    pred, true = assessment.lengths_mm
    top = max(float(np.percentile(v, 99.5)) for v in (pred, true) if len(v))
    bins = [float(b) for b in np.linspace(0, max(top, 1e-3), 61)]
    for values, name, colour in ((true, "true", QUIET), (pred, "predicted", COLOURS[0])):
        if len(values):
            share = np.full(len(values), 1 / len(values))
            style: dict[str, Any] = {"histtype": "step", "linewidth": 1.8, "color": colour}
            label = f"{len(values):,} {name} strands"
            axes.hist(np.minimum(values, bins[-1]), bins, weights=share, label=label, **style)
    axes.set_xlabel("length, mm (the last bar holds all that are longer)", color=QUIET)
    axes.set_ylabel("share of strands", color=QUIET)
    apart = assessment.figures["lengths"].get("distance_mm")
    title = "Strand lengths" + (f", {apart:.3g} mm apart" if apart is not None else "")
    axes.set_title(title, **TITLE)
    axes.legend(frameon=False, fontsize=9, labelcolor=INK)
    clean_axes(axes, grid_axis="y")
    return figure

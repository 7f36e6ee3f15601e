"""Images of the errors of strands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure

from reconstruction.arrays import AnyFloats
from reconstruction.evaluation.assessment import Assessment, Nearest
from reconstruction.report.plots import INK, QUIET, TITLE, WIDTH, save_figure

VIEWS = {
    "front": ((1, 0, 0), (0, 0, 1)),
    "left side": ((0, 1, 0), (0, 0, 1)),
    "back": ((-1, 0, 0), (0, 0, 1)),
    "right side": ((0, -1, 0), (0, 0, 1)),
    "top": ((1, 0, 0), (0, 1, 0)),
}
"""Right and up directions of each view, which is along minus their cross product."""

STEPS_MM = (0.0, 1.0, 2.0, 3.0, 5.0)
STEPS_DEG = (0.0, 10.0, 20.0, 30.0, 45.0)
GOOD_TO_BAD = ("#0f6e84", "#74b3a2", "#e6c34e", "#dd7438", "#84202f")


def draw_errors(assessment: Assessment, folder: str | Path) -> list[Path]:
    """Write PNGs into `folder` and return their paths.

    `distance.png`, `angle.png`: the scored points in five orthographic views (the nearer half),
    coloured by distance and angle to the nearest point of the other set. Top row: predicted points,
    wrong where red; bottom row: true points, missing where red.
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
            order = np.argsort(towards)  # nearer points are drawn last
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

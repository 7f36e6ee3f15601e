"""Small figures of conventions, drawn by the build of the site."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from reconstruction.geometry.lights import dome_positions

AXES = {"face −y": (0, -1, 0), "left +x": (1, 0, 0), "back +y": (0, 1, 0), "right −x": (-1, 0, 0)}
"""Horizontal directions of a head, by its own left and right."""
LIGHTS, LOWEST_DEG = 24, -50.0
Point = tuple[float, float]
BLUE, RED, GREY = "#1f5fa8", "#b3372f", "#777777"


def column_of(direction: ArrayLike) -> float:
    """Column of a lat-long map, 0 to 1, that lights from `direction (3,)` (environment.py)."""
    x, y, _ = np.asarray(direction, float)
    return float((0.5 - np.arctan2(y, x) / (2 * np.pi)) % 1.0)


def write_figures(folder: Path) -> None:
    """Write environment.svg, lights.svg and camera.svg; one that has not changed keeps its time."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, draw in (("environment", environment), ("lights", lights), ("camera", camera)):
        figure = Figure(figsize=(5.2, 2.0), layout="constrained")
        draw(figure)
        new = folder / f"{name}.new"
        with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": name, "font.size": 8}):
            figure.savefig(new, format="svg", metadata={"Date": None})
        path = folder / f"{name}.svg"
        if not path.exists() or path.read_bytes() != new.read_bytes():
            new.replace(path)
        new.unlink(missing_ok=True)


def environment(figure: Figure) -> None:
    """A map with the directions of its columns, and the head from above."""
    left, right = figure.subplots(1, 2, width_ratios=(2.2, 1))
    left.set(xlim=(0, 1), ylim=(0, 1), xticks=(), yticks=(), title="environment map")
    for name, direction in AXES.items():
        at = column_of(direction)
        for x in {at, 1.0} if at == 0 else {at}:
            left.axvline(x, color=RED if "face" in name else GREY, lw=1.2)
            left.text(x, 0.5, name, rotation=90, ha="right" if x else "left", va="center")
    left.text(0.02, 0.95, "zenith +z", va="top", color=BLUE)
    left.text(0.02, 0.05, "nadir −z", va="bottom", color=BLUE)
    _head(right)
    right.set_title("head from above")


def _head(axes: Any) -> None:
    axes.add_patch(mpl.patches.Ellipse((0, 0), 0.9, 1.1, fill=False, lw=1.2))
    axes.plot([-0.12, 0, 0.12], [-0.53, -0.72, -0.53], color="black", lw=1.2)  # the nose
    for name, (x, y, _) in AXES.items():
        _arrow(axes, (0.6 * x, 0.78 * y), (0.9 * x, 1.05 * y), name, "black")
    axes.set(xlim=(-1.9, 1.9), ylim=(-1.4, 1.4), aspect="equal")
    axes.axis("off")


def _arrow(axes: Any, start: Point, end: Point, name: str, colour: str) -> None:
    """An arrow with its name beyond the tip."""
    axes.annotate("", end, start, arrowprops={"arrowstyle": "->", "color": colour})
    dx, dy = np.subtract(end, start)
    align = "left" if dx > abs(dy) else "right" if -dx > abs(dy) else "center"
    upright = "bottom" if dy > abs(dx) else "top" if -dy > abs(dx) else "center"
    if axes.yaxis_inverted():
        upright = {"bottom": "top", "top": "bottom"}.get(upright, upright)
    axes.text(*end, f" {name} ", color=colour, ha=align, va=upright)


def lights(figure: Figure) -> None:
    """Numbers of a dome's lights, from above and from the front."""
    places = dome_positions(LIGHTS, 1.0, LOWEST_DEG)
    top, front = figure.subplots(1, 2)
    for axes, across, up, depth, title in (
        (top, 0, 1, 2, "from above (face −y)"),
        (front, 0, 2, 1, "from the front"),
    ):
        for k, p in enumerate(places):
            near = p[depth] > 0 if depth == 2 else p[depth] < 0
            axes.text(p[across], p[up], k, color=BLUE if near else "#b0b0b0", ha="center", size=7)
        axes.set(xlim=(-1.2, 1.2), ylim=(-1.2, 1.2), aspect="equal", title=title)
        axes.axis("off")


def camera(figure: Figure) -> None:
    """The image's axes and pixel centres, and the camera's axes in the world."""
    left, right = figure.subplots(1, 2)
    for k in range(4):
        left.plot([-0.5, 3.5], [k - 0.5, k - 0.5], color=GREY, lw=0.6)
        left.plot([k - 0.5, k - 0.5], [-0.5, 2.5], color=GREY, lw=0.6)
    left.plot([3.5, 3.5], [-0.5, 2.5], color=GREY, lw=0.6)
    left.plot(0, 0, "o", color=RED, ms=3)
    left.text(0.15, 0.1, "(0, 0)", color=RED, va="center")
    left.invert_yaxis()
    _arrow(left, (-0.9, -0.9), (3.5, -0.9), "x", "black")
    _arrow(left, (-0.9, -0.9), (-0.9, 2.5), "y", "black")
    left.set(xlim=(-1.3, 4.3), ylim=(3.1, -1.3), aspect="equal", title="image: pixel centres")
    for x, y, name in ((-0.7, -0.25, "x right"), (0, -0.8, "y down"), (0.7, 0.3, "z forward")):
        _arrow(right, (0, 0), (x, y), name, BLUE)
    for x, y, name in ((0, 0.7, "world z up"), (0.7, 0, "x"), (0.4, 0.35, "y")):
        _arrow(right, (1.7, 0.6), (1.7 + x, 0.6 + y), name, RED)
    right.plot(1.7, 0.6, "o", color=RED, ms=3)
    right.plot(0, 0, "s", color=BLUE, ms=6)
    right.set(xlim=(-1.6, 2.8), ylim=(-1.2, 1.6), aspect="equal", title="X_cam = R X_world + t")
    right.axis("off")
    left.axis("off")

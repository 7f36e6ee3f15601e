"""Colour chart and grey ball of an import, found and drawn, with their lines for import.toml."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from reconstruction.arrays import Array, Bools, Floats
from reconstruction.capture.grey_ball import GreyBall, PlacedBall
from reconstruction.capture.import_folder import Import
from reconstruction.files.durable import write_whole
from reconstruction.images.colour_chart import Chart, find_ball, find_chart
from reconstruction.images.srgb import srgb

MOST_LIGHTS = 16  # single-light images summed if there is no all_on
WIDTH, COLUMNS = 480, 4
GREEN, YELLOW = (80, 220, 80), (40, 220, 240)
CAMERAS_DIFFER = 0.03
"""Relative difference of white balance between cameras that is noted."""


@dataclass(frozen=True)
class Targets:
    """`toml` lines for import.toml, empty if nothing was found; `notes` for the user."""

    toml: str
    notes: tuple[str, ...]


def find_targets(understood: Import, out: Path) -> Targets:
    """Search all cameras and draw what was found into the PNG `out`, camera by camera.

    Patches of the chart are outlined in yellow, the ball in green. Raises `ImportProblem` for an
    image that cannot be read.
    """
    charts: dict[str, Chart] = {}
    circles: dict[str, tuple[float, float, float]] = {}
    cells = []
    for name in understood.shot:
        picture = _picture(understood, name)
        if picture is None:
            continue
        image, saturated = picture
        if (chart := find_chart(image, saturated)) is not None:
            charts[name] = chart
        if (circle := find_ball(image)) is not None:
            circles[name] = circle
        cells.append(_drawn(image, name, chart, circle))
    if cells:
        write_whole(out, cv2.imencode(".png", _tiled(cells))[1].tobytes())
    white, said = _white_balance(understood, charts)
    ball, more = _ball(understood, circles)
    return Targets("\n".join([*white, *ball]), (*said, *more))


def _picture(understood: Import, camera: str) -> tuple[Floats, Bools] | None:
    """The camera's fully lit image, else the sum of single lights, and saturated pixels."""
    frames = understood.found.frames
    steps = [s for s in understood.found.steps if (s.index, camera) in frames]
    lit = [s for s in steps if s.kind == "all_on"][:1] or [s for s in steps if s.kind == "olat"]
    lit = lit[:: max(1, len(lit) // MOST_LIGHTS)]
    merged = [understood.frames.frame(frames[s.index, camera], camera) for s in lit]
    if not merged:
        return None
    saturated: Bools = np.any([m.saturated for m in merged], axis=0)
    return np.asarray(np.sum([m.radiance for m in merged], axis=0)), saturated


def _white_balance(
    understood: Import, charts: dict[str, Chart]
) -> tuple[list[str], tuple[str, ...]]:
    if not charts:
        return [], (
            "no chart of 24 colours was found in any camera: show all of it, 100 pixels wide or "
            "more, without highlights",
        )
    each = np.array([c.white_balance for c in charts.values()])
    red, _, blue = factors = np.median(each, axis=0)
    error = max(c.error for c in charts.values())
    note = f"chart in {', '.join(charts)}: red x {red:.3f}, blue x {blue:.3f}, error {error:.1%}"
    notes = [note]
    if (apart := float(np.abs(each / factors - 1).max())) > CAMERAS_DIFFER:
        notes.append(
            f"the cameras' white balance differs by {apart:.0%}: is the chart in coloured light?"
        )
    given = understood.settings.sensor.matrix
    matrix = factors[:, None] * (np.eye(3) if given is None else np.array(given))
    rows = ", ".join(f"[{', '.join(f'{v:.4f}' for v in row)}]" for row in matrix)
    return ["[sensor]", f"matrix = [{rows}]"], tuple(notes)


def _ball(
    understood: Import, circles: dict[str, tuple[float, float, float]]
) -> tuple[list[str], tuple[str, ...]]:
    lines = [f"{n} = [{x:.2f}, {y:.2f}, {r:.2f}]" for n, (x, y, r) in circles.items()]
    lines = ["[grey_ball]", "albedo = 0.18 # as measured", "[grey_ball.circles]", *lines]
    if len(circles) < 2:
        seen = f"only in {next(iter(circles))}" if circles else "in no camera"
        return [], (f"a ball was found {seen}, expected two cameras or more",)
    try:
        placed = PlacedBall.of(GreyBall(circles), understood.shot)
    except ValueError as error:
        return lines, (f"the circles are not one ball ({error}): remove wrong ones",)
    return lines, (f"ball in {', '.join(circles)}: radius {1e3 * placed.radius:.1f} mm",)


def _drawn(
    image: Floats, name: str, chart: Chart | None, circle: tuple[float, float, float] | None
) -> Array:
    """The image with the outlines, `WIDTH` pixels wide."""
    scale = WIDTH / image.shape[1]
    full = max(float(np.percentile(image, 99.5)), 1e-12)
    out = np.round(255 * srgb(image[..., ::-1] / full)).astype(np.uint8)
    out = cv2.resize(out, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    if chart is not None:
        boxes = [np.round((b + 0.5) * scale - 0.5).astype(np.int32) for b in chart.patches]
        cv2.polylines(out, boxes, True, YELLOW, 1, cv2.LINE_AA)
    if circle is not None:
        x, y, radius = ((v + s) * scale - s for v, s in zip(circle, (0.5, 0.5, 0.0), strict=True))
        at = (round(16 * x), round(16 * y))
        cv2.circle(out, at, round(16 * radius), GREEN, 1, cv2.LINE_AA, shift=4)
    cv2.putText(out, name, (6, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
    return np.asarray(out)


def _tiled(cells: list[Array]) -> Array:
    height = max(c.shape[0] for c in cells)
    cells = [np.pad(c, ((0, height - len(c)), (0, 0), (0, 0))) for c in cells]
    cells += [np.zeros_like(cells[0])] * (-len(cells) % min(COLUMNS, len(cells)))
    columns = min(COLUMNS, len(cells))
    rows = [np.hstack(cells[k : k + columns]) for k in range(0, len(cells), columns)]
    return np.vstack(rows)

"""Colour chart and balls of an import, found and drawn, with their lines for import.toml.

Mirror balls give the lights, or the errors of the given ones.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from reconstruction.arrays import AnyFloats, Array, Bools, Floats
from reconstruction.capture.grey_ball import Circle, GreyBall, PlacedBall
from reconstruction.capture.import_folder import Import
from reconstruction.files.durable import write_whole
from reconstruction.images.colour_chart import Chart, find_balls, find_chart
from reconstruction.images.grey import grey
from reconstruction.images.mirror_balls import (
    FoundLight,
    Reflection,
    compared,
    group,
    highlights,
    locate,
    reflect,
)
from reconstruction.images.srgb import srgb

MOST_LIGHTS = 16  # single-light images summed if there is no all_on
WIDTH, COLUMNS = 480, 4
GREEN, YELLOW, PINK = (80, 220, 80), (40, 220, 240), (220, 80, 240)
CAMERAS_DIFFER = 0.03
"""Relative difference of white balance between cameras that is noted."""
OFF = 5.0
"""Degrees from a given light that are noted."""


Mirrors = dict[str, dict[Circle, dict[str, Array]]]
"""Highlights' pixels by light, of mirror balls by their outlines in each camera."""


@dataclass(frozen=True)
class Targets:
    """`toml` lines for import.toml, empty if nothing was found; `notes` for the user.

    `lights` by mirror balls, by name; `off_deg` is how far the given ones are off.
    """

    toml: str
    notes: tuple[str, ...]
    lights: Mapping[str, FoundLight]
    off_deg: Mapping[str, float]


def find_targets(understood: Import, out: Path, given: bool = True) -> Targets:
    """Search all cameras and draw what was found into the PNG `out`, camera by camera.

    Patches of the chart are outlined in yellow, the grey ball in green, mirror balls and their
    highlights in pink. `given`: the import has lights, to compare with. Raises `ImportProblem` for
    an image that cannot be read.
    """
    charts: dict[str, Chart] = {}
    circles: dict[str, Circle] = {}
    mirrors: Mirrors = {}
    cells, several = [], 0
    for name in understood.shot:
        picture = _picture(understood, name)
        if picture is None:
            continue
        image, saturated = picture
        if (chart := find_chart(image, saturated)) is not None:
            charts[name] = chart
        own, balls = understood.settings.mirror_balls.circles, find_balls(image)
        singles = _singles(understood, name) if balls or own.get(name) else {}
        for circle in dict.fromkeys([*own.get(name, ()), *balls]):
            found = highlights(singles, circle)
            if found is None:
                circles.setdefault(name, circle)
            elif circle in own.get(name, ()) or not own:
                mirrors.setdefault(name, {})[circle] = found[0]
                several += found[1]
        cells.append(_drawn(image, name, chart, circles.get(name), mirrors.get(name, {})))
    if cells:
        write_whole(out, cv2.imencode(".png", _tiled(cells))[1].tobytes())
    white, said = _white_balance(understood, charts)
    ball, more = _ball(understood, circles)
    mirror, rays = _reflections(understood, mirrors)
    off = compared(rays, {x.name: x for x in understood.rig.lights}) if given else {}
    by_light = {n: [r for r in rays if r.light == n] for n in sorted({r.light for r in rays})}
    lights = {n: locate(some) for n, some in by_light.items()}
    about = _on_lights(len(understood.rig.lights), lights, off, several) if mirrors else []
    return Targets("\n".join([*white, *ball, *mirror]), (*said, *more, *about), lights, off)


def write_lights(
    understood: Import, lights: Mapping[str, FoundLight], distance: float | None, out: Path
) -> int:
    """Write the JSON `out` of lights' positions, metres in the user's axes, and count them.

    `distance` in metres from the stage's origin is that of lights whose own is undetermined.
    """
    world = replace(understood.world, unit=1.0)
    places = {name: light.position(distance) for name, light in lights.items()}
    entries = [
        {"id": n, "position": np.round(world.to_user(p), 5).tolist()}
        for n, p in places.items()
        if p is not None
    ]
    if entries:
        text = json.dumps({"units": {"position": "m"}, "lights": entries}, indent=1)
        write_whole(out, text.encode())
    return len(entries)


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


def _singles(understood: Import, camera: str) -> dict[str, tuple[AnyFloats, Bools]]:
    """Grey frames `(H, W)` of single lights and their saturated pixels."""
    frames, out = understood.found.frames, {}
    for step in understood.found.steps:
        if step.kind == "olat" and step.light and (step.index, camera) in frames:
            merged = understood.frames.frame(frames[step.index, camera], camera)
            out[step.light] = grey(merged.radiance), merged.saturated
    return out


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


def _ball(understood: Import, circles: dict[str, Circle]) -> tuple[list[str], tuple[str, ...]]:
    lines = [f"{n} = [{x:.2f}, {y:.2f}, {r:.2f}]" for n, (x, y, r) in circles.items()]
    lines = ["[grey_ball]", "albedo = 0.18 # as measured", "[grey_ball.circles]", *lines]
    if len(circles) < 2:
        seen = f"only in {next(iter(circles))}" if circles else "in no camera"
        return [], (f"a grey ball was found {seen}, expected two cameras or more",)
    try:
        placed = PlacedBall.of(GreyBall(circles), understood.shot)
    except ValueError as error:
        return lines, (f"the circles are not one ball ({error}): remove wrong ones",)
    return lines, (f"ball in {', '.join(circles)}: radius {1e3 * placed.radius:.1f} mm",)


def _reflections(understood: Import, mirrors: Mirrors) -> tuple[list[str], list[Reflection]]:
    """Lines for import.toml, and the rays to the lights."""
    if not mirrors:
        return [], []
    radius = understood.settings.mirror_balls.radius
    circles = {name: list(some) for name, some in mirrors.items()}
    rays = [
        reflect(understood.shot[name], circle, center, size, light, pixel)
        for ball, center, size in group(circles, understood.shot, radius)
        for name, circle in ball.items()
        for light, pixel in mirrors[name][circle].items()
    ]
    lines = ["[mirror_balls]", *([] if radius is None else [f"radius = {radius:g}"])]
    lines.append("[mirror_balls.circles]")
    lines += [f"{n} = {[[round(v, 2) for v in c] for c in some]}" for n, some in circles.items()]
    return lines, [r for r in rays if r is not None]


def _on_lights(
    count: int, lights: Mapping[str, FoundLight], off: Mapping[str, float], several: int
) -> list[str]:
    error = np.degrees(np.median([x.error for x in lights.values()])) if lights else np.nan
    placed = [x.unsure for x in lights.values() if x.distance is not None]
    note = f"mirror balls: {len(lights)} of {count} lights, directions within about {error:.1f}°"
    notes = [f"{note}, distances of {len(placed)}"]
    if placed:
        notes[0] += f" within about {np.median(placed):.0%}"
    if several:
        notes.append(f"{several} frames show several highlights alike on a mirror ball: not used")
    if off:
        worst = sorted(off, key=lambda n: -off[n])[:5]
        text = f"given lights lie {np.median(list(off.values())):.1f}° off the mirror balls'"
        notes.append(f"{text} in the median, " + ", ".join(f"{n} {off[n]:.1f}°" for n in worst))
        if off[worst[0]] > OFF:
            notes.append(f"lights over {OFF:g}° off: check their positions, order, axes and unit")
    return notes


def _drawn(
    image: Floats,
    name: str,
    chart: Chart | None,
    grey_ball: Circle | None,
    mirrors: Mapping[Circle, Mapping[str, Array]],
) -> Array:
    """The image with the outlines, `WIDTH` pixels wide."""
    scale = WIDTH / image.shape[1]
    full = max(float(np.percentile(image, 99.5)), 1e-12)
    out = np.round(255 * srgb(image[..., ::-1] / full)).astype(np.uint8)
    out = cv2.resize(out, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    if chart is not None:
        boxes = [np.round((b + 0.5) * scale - 0.5).astype(np.int32) for b in chart.patches]
        cv2.polylines(out, boxes, True, YELLOW, 1, cv2.LINE_AA)
    balls = [(c, PINK, p.values()) for c, p in mirrors.items()]
    for circle, colour, pixels in [*balls, *([(grey_ball, GREEN, ())] if grey_ball else [])]:
        for x, y, radius in (circle, *((*p, 2 / scale) for p in pixels)):
            at = [round(16 * ((v + 0.5) * scale - 0.5)) for v in (x, y)]
            cv2.circle(out, at, round(16 * radius * scale), colour, 1, cv2.LINE_AA, shift=4)
    cv2.putText(out, name, (6, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
    return np.asarray(out)


def _tiled(cells: list[Array]) -> Array:
    height = max(c.shape[0] for c in cells)
    cells = [np.pad(c, ((0, height - len(c)), (0, 0), (0, 0))) for c in cells]
    cells += [np.zeros_like(cells[0])] * (-len(cells) % min(COLUMNS, len(cells)))
    columns = min(COLUMNS, len(cells))
    rows = [np.hstack(cells[k : k + columns]) for k in range(0, len(cells), columns)]
    return np.vstack(rows)

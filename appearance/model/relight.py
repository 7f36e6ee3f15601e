"""A fitted model under another light: the relit image."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from appearance.metrics.pictures import write_png
from appearance.metrics.scores import Exposure
from appearance.model.fitted_model import FittedModel
from appearance.render.coverage import coverage
from appearance.render.smoothed import SHOWN, environment_smoothed
from reconstruction import Camera, Model, Strands, write_exr
from reconstruction.arrays import AnyFloats, Array, Floats

MARGIN = 1.02
"""Margin around long hair."""
LEAST = 1e-3
"""Least radius of the view, metres, for strands in one place."""


def relight(
    fitted: FittedModel,
    model: Model,
    envmap: AnyFloats,
    *,
    size: int = 640,
    spp: int = 32,
    seed: int = 0,
) -> Floats:
    """Render `fitted` in three-quarter view under `envmap (h, w, 3)`: `(N, N, 3)`, N = `size`.

    Writes `relit.exr` (radiance) and `relit.png` (the subject's 99th percentile at white, sRGB)
    into `model`.
    """
    scene, camera = fitted.scene(), three_quarter_view(fitted.strands, size)
    radiance = environment_smoothed(scene, camera, envmap, replace(SHOWN, spp=spp, seed=seed))
    share = coverage(scene, camera, 4)
    subject = share["hair"] + share["head"] > 0.5
    shown = radiance[subject] if subject.any() else radiance  # sparse hair fills no pixel
    with model.writing("relit.exr") as part:
        write_exr(part, radiance)
    with model.writing("relit.png") as part:
        write_png(part, Exposure.of_picture(shown)(radiance))
    return radiance


def three_quarter_view(strands: Strands, size: int, round_deg: float = 0.0) -> Camera:
    """A camera of `size`² pixels with all `strands` in view from the front left, slightly above.

    The face looks along −y. `round_deg` rotates the camera about z, counter-clockwise from above.
    Raises `ValueError` without strands.
    """
    if not len(strands):
        raise ValueError("there are no strands to see: give a camera of the capture's rig")
    low, high = strands.points.min(axis=0).astype(float), strands.points.max(axis=0).astype(float)
    middle, reach = 0.5 * (low + high), max(0.5 * float(np.linalg.norm(high - low)), LEAST)
    c, s = np.cos(np.radians(round_deg)), np.sin(np.radians(round_deg))
    direction = np.array([0.62 * c + 0.75 * s, 0.62 * s - 0.75 * c, 0.22])
    distance = 6.0 * reach
    direction /= np.linalg.norm(direction)
    half = max(
        np.arcsin(0.85 * reach / distance), _half_angle(strands, middle, distance, direction)
    )
    fov = float(np.degrees(2 * half))
    return Camera.look_at("three_quarter", size, size, middle + distance * direction, middle, fov)


def _half_angle(strands: Strands, middle: Array, distance: float, direction: Array) -> float:
    """Half of the largest angle, radians, that `strands` subtend on a turn of the camera."""
    x, y, up = (strands.points.astype(float) - middle).T
    out, level, rise = np.hypot(x, y), float(np.hypot(*direction[:2])), direction[2]
    # largest offsets of a point to the side, above and below the image's centre during a turn
    beside = out / np.sqrt((distance - up * rise) ** 2 - (out * level) ** 2)
    above = [
        np.abs(up * level - near * rise) / (distance - up * rise - near * level)
        for near in (out, -out)
    ]
    return float(np.arctan(MARGIN * np.max([beside, *above])))

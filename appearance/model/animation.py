"""Animations of a fitted model: a turntable, turning light, or moving hair."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from appearance.metrics.scores import Exposure
from appearance.model.fitted_model import FittedModel
from appearance.model.relight import three_quarter_view
from appearance.render.coverage import coverage, covered_pixels
from appearance.render.mixed import Environment
from appearance.render.olat import render_indirect, render_olat, spread_out
from appearance.render.smoothed import (
    environment_smoothed,
    mean_factor,
    olat_smoothed,
    smoothed,
    without_rare,
)
from appearance.render.tracing import Sampling
from reconstruction import Camera, Light, Progress, Strands, silent
from reconstruction.arrays import AnyFloats, Array, Floats
from reconstruction.files.durable import writing

SECONDS = 3.0
"""Duration of an animation."""
CELLS = 10, 24
"""Rows and columns of a turning map's panels."""
_FAR = 100.0
"""Metres to these panels."""
_DIRECT = 64
"""Least number of paths a pixel of light at the first hit."""
_SAMPLED = {"first_lights": 24, "deep_lights": 16}
"""Panels sampled at a path's first and later vertices."""
_PIXELS = 10_000
"""Pixels in memory at once, under every panel."""


def moving(
    fitted: FittedModel,
    poses: Sequence[Strands],
    camera: Camera,
    lit: tuple[Sequence[Light], Sequence[Environment]],
    sampling: Sampling,
    progress: Progress = silent,
) -> Floats:
    """Radiance `(T, H, W, 3)` of the model in each of `poses`, under the same lights and maps.

    Its field moves with the strands. All frames have the same random numbers, against flicker.
    Raises `ValueError` for poses of another topology.
    """
    out, maps = [], [x.shown() for x in lit[1]]
    for k, pose in enumerate(poses):
        progress(f"frame {k + 1} of {len(poses)}", k / len(poses))
        scene, frame = fitted.scene(pose), np.zeros((camera.height, camera.width, 3), np.float32)
        for light in lit[0]:
            frame += olat_smoothed(scene, camera, [light], sampling)[0]
        for envmap in maps:
            frame += environment_smoothed(scene, camera, envmap, sampling)
        out.append(frame)
    return np.stack(out)


def turntable(
    fitted: FittedModel,
    room: Environment,
    frames: int,
    size: int,
    sampling: Sampling,
    progress: Progress = silent,
) -> Floats:
    """Radiance `(T, N, N, 3)`, N = `size`: the model turns once before the camera, and the room's
    map once the other way. Raises `ValueError` without a frame."""
    if frames < 1:
        raise ValueError(f"a turntable needs a frame, got {frames}")
    scene, envmap, out = fitted.scene(), room.shown(), []
    for k in range(frames):
        progress(f"frame {k + 1} of {frames}", k / frames)
        camera = three_quarter_view(fitted.strands, size, 360 * k / frames)
        # in the model's frame the room goes round twice while the camera goes round once
        turned = np.roll(envmap, -round(2 * envmap.shape[1] * k / frames), axis=1)
        out.append(environment_smoothed(scene, camera, turned, sampling))
    return np.stack(out)


def turning_light(
    fitted: FittedModel,
    room: Environment,
    frames: int,
    size: int,
    sampling: Sampling,
    progress: Progress = silent,
) -> Floats:
    """Radiance `(T, N, N, 3)`, N = `size`: `three_quarter_view` while the map turns round once.

    Counter-clockwise from above. The model is rendered once under each of `CELLS` panels that tile
    the sphere; a frame is the sum of these images weighted by the turned map's mean over each
    panel. First-hit light has at least `_DIRECT` paths a pixel, indirect light is smoothed. Raises
    `ValueError` without a frame.
    """
    if frames < 1:
        raise ValueError(f"an animation needs a frame, got {frames}")
    envmap = room.shown()
    weights = np.stack([cell_means(envmap, k / frames) for k in range(frames)]).astype(np.float32)
    scene, camera = fitted.scene(), three_quarter_view(fitted.strands, size)
    index, panels = covered_pixels(scene, camera), _panels()
    spp, seed, more = sampling.spp, sampling.seed, max(sampling.spp, _DIRECT) // 2
    parts = np.zeros((3, frames, len(index), 3), np.float32)
    tiles = -(-len(index) // _PIXELS)
    for k in range(tiles):
        progress("rendering all directions of light", k / tiles)
        at = slice(k, None, tiles)
        first: dict[str, Any] = {"pixels": index[at], "spp": more, "max_depth": 1, **_SAMPLED}
        rest: dict[str, Any] = {"spp": spp, "max_depth": sampling.max_depth, **_SAMPLED}
        lit = (
            render_olat(scene, camera, panels, seed=4 * seed + 1, **first),
            render_olat(scene, camera, panels, seed=4 * seed + 2, **first),
            render_indirect(scene, camera, panels, index[at], seed=4 * seed, **rest),
        )
        for part, each in zip(parts, lit, strict=True):
            part[:, at] = np.einsum("tlc,lpc->tpc", weights, each, optimize=True)
    share, sigma = coverage(scene, camera, max(spp, 16), seed), max(2.0, size / 100)
    out = []
    for k, (one, other, indirect) in enumerate(
        zip(*(spread_out(part, index, camera) for part in parts), strict=True)
    ):
        turned = np.roll(envmap, -round(envmap.shape[1] * k / frames), axis=1)
        factor = mean_factor(scene, camera, turned, index)
        indirect = smoothed(indirect[None], share, sigma)[0] * factor
        out.append(without_rare(one, other, share, sigma) + indirect)
    return np.stack(out)


def cell_means(envmap: AnyFloats, turned: float) -> Array:
    """Mean radiance of `envmap (h, w, 3)` over each of `CELLS`: `(rows · columns, 3)`.

    The map has `turned` counter-clockwise, 1 being once round. Row by row from the zenith; columns
    go clockwise from −x, as those of a map.
    """
    rows, columns = CELLS
    height, width = envmap.shape[:2]
    edges = np.cos(np.linspace(0, np.pi, height + 1))
    wanted = np.cos(np.linspace(0, np.pi, rows + 1))
    solid = (edges[:-1] - edges[1:])[:, None, None]
    bands = _between(envmap * solid, np.interp(-wanted, -edges, np.arange(height + 1.0)))
    bands /= (wanted[:-1] - wanted[1:])[:, None, None]
    twice = np.concatenate([bands, bands], axis=1).swapaxes(0, 1)
    places = (np.arange(columns + 1) / columns + turned % 1) * width
    means = _between(twice, places) * columns / width
    return means.swapaxes(0, 1).reshape(-1, 3)


def _between(values: AnyFloats, places: Array) -> Array:
    """Sums of `values (n, …)` between neighbours of `places (m,)`, whole or not: `(m - 1, …)`."""
    total = np.concatenate([np.zeros((1, *values.shape[1:])), np.cumsum(values, 0, np.float64)])
    low = np.minimum(places.astype(int), len(values) - 1)
    share = (places - low).reshape(-1, *(1,) * (values.ndim - 1))
    return np.asarray(np.diff(total[low] * (1 - share) + total[low + 1] * share, axis=0))


def _panels() -> list[Light]:
    """A far panel of unit radiance that faces the subject for each of `CELLS`."""
    rows, columns = CELLS
    edges, out = np.linspace(0, np.pi, rows + 1), []
    for r in range(rows):
        theta = 0.5 * (edges[r] + edges[r + 1])
        solid = (np.cos(edges[r]) - np.cos(edges[r + 1])) * 2 * np.pi / columns
        size = _FAR * 2 * np.pi / columns * np.sin(theta), _FAR * np.pi / rows
        for c in range(columns):
            phi = 2 * np.pi * (0.5 - (c + 0.5) / columns)
            flat = np.array([np.cos(phi), np.sin(phi), 0.0])
            towards = np.sin(theta) * flat + np.array([0, 0, np.cos(theta)])
            right = np.array([-flat[1], flat[0], 0.0])
            aim = np.stack([right, np.cross(-towards, right), -towards])
            intensity = np.full(3, solid * _FAR**2)
            name = f"panel_{r}_{c}"
            out.append(Light(name, _FAR * towards, intensity, orientation=aim, size=size))
    return out


def write_animation(path: Path, frames: Floats, seconds: float = SECONDS) -> None:
    """Write radiance `(T, H, W, 3)` as an endless WebP of `seconds`, all frames exposed alike.

    Raises `ValueError` where `path` is no `.webp`, or radiance is not finite.
    """
    if path.suffix != ".webp":
        raise ValueError(f"{path}: an animation is a .webp file")
    if not np.isfinite(frames).all():
        raise ValueError(f"{path}: an animation wants finite radiance, and this has NaN or inf")
    values = np.rint(Exposure.of_picture(frames)(frames) * 255).astype(np.uint8)
    film = cv2.Animation()
    film.frames = [np.ascontiguousarray(frame[..., ::-1]) for frame in values]
    film.durations = [round(1000 * seconds / len(values))] * len(values)
    with writing(path) as part:
        done, data = cv2.imencodeanimation(".webp", film, [cv2.IMWRITE_WEBP_QUALITY, 85])
        if not done:
            raise OSError(f"{path} cannot be written")
        part.write_bytes(data.tobytes())

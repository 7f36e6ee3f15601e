"""Moving pictures of a fitted model: a turntable, or hair that moves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from appearance.metrics.scores import Exposure
from appearance.model.fitted_model import FittedModel
from appearance.model.relight import three_quarter_view
from appearance.render.mixed import Environment
from appearance.render.smoothed import environment_smoothed, olat_smoothed
from appearance.render.tracing import Sampling
from appearance.scene.hair_scene import HairScene
from reconstruction import Camera, Light, Progress, Strands, silent
from reconstruction.arrays import Floats
from reconstruction.files.durable import writing

SECONDS = 3.0
"""Of a turn, or a sway."""
_LAG = 1.5
"""Radians that a tip is behind its root in a sway."""
_ACROSS = 12.0
"""Radians a metre that roots are behind each other."""


def sway(strands: Strands, frames: int, degrees: float) -> list[Strands]:
    """The poses of hair that swings from side to side once: the last goes over into the first.

    Each segment is turned about the direction of sight (y), the more the nearer the tip, up to
    `degrees`; lengths stay. Nothing keeps strands out of the head. Raises `ValueError` for fewer
    than two frames, or degrees beyond 0 to 45.
    """
    if frames < 2:
        raise ValueError(f"a sway needs at least 2 frames, got {frames}")
    if not 0 <= degrees <= 45:
        raise ValueError(f"hair sways by 0 to 45 degrees, got {degrees}")
    points, first = strands.points.astype(np.float64), strands.offsets[:-1]
    counts = np.diff(strands.offsets)
    strand = np.repeat(np.arange(len(counts)), counts)
    along = (np.arange(len(points)) - first[strand]) / np.maximum(counts[strand] - 1, 1)
    root = points[first[strand]]
    steps = np.diff(points, axis=0, prepend=points[:1])
    poses = []
    for k in range(frames):
        phase = 2 * np.pi * k / frames - _LAG * along - _ACROSS * root[:, 0]
        angle = np.radians(degrees) * along * np.sin(phase)
        c, s = np.cos(angle), np.sin(angle)
        turned = np.stack([c * steps[:, 0] - s * steps[:, 2], steps[:, 1]], -1)
        turned = np.column_stack([turned, s * steps[:, 0] + c * steps[:, 2]])
        total = np.cumsum(turned, axis=0)
        moved = root + total - total[first[strand]]
        poses.append(replace(strands, points=moved.astype(strands.points.dtype)))
    return poses


def moving(
    fitted: FittedModel,
    poses: Sequence[Strands],
    camera: Camera,
    lit: tuple[Sequence[Light], Sequence[Environment]],
    sampling: Sampling,
    progress: Progress = silent,
) -> Floats:
    """Radiance `(T, H, W, 3)` of the model in each of `poses`, under the same lights and maps.

    Its field moves with the strands. Raises `ValueError` for poses of another topology.
    """
    out = []
    for k, pose in enumerate(poses):
        progress(f"frame {k + 1} of {len(poses)}", k / len(poses))
        out.append(_picture(fitted.scene(pose), camera, *lit, sampling))
    return np.stack(out)


def turntable(
    fitted: FittedModel,
    room: Environment,
    frames: int,
    size: int,
    sampling: Sampling,
    progress: Progress = silent,
) -> Floats:
    """Radiance `(T, N, N, 3)`, N = `size`: the model turns once before the camera, and the room
    with its map once the other way. Raises `ValueError` without a frame.
    """
    if frames < 1:
        raise ValueError(f"a turntable needs a frame, got {frames}")
    scene, out = fitted.scene(), []
    for k in range(frames):
        progress(f"frame {k + 1} of {frames}", k / frames)
        camera = three_quarter_view(fitted.strands, size, 360 * k / frames)
        # in the model's frame the room goes round twice while the camera goes round once
        envmap = np.asarray(room.envmap, np.float32)
        turned = np.roll(envmap, -round(2 * envmap.shape[1] * k / frames), axis=1)
        out.append(environment_smoothed(scene, camera, turned, sampling))
    return np.stack(out)


def write_animation(path: Path, frames: Floats, seconds: float = SECONDS) -> None:
    """Write radiance `(T, H, W, 3)` as an endless WebP of `seconds`, all frames exposed alike.

    Raises `ValueError` where `path` is no `.webp`.
    """
    if path.suffix != ".webp":
        raise ValueError(f"{path}: an animation is a .webp file")
    lit = frames[frames.sum(axis=-1) > 0]
    exposed = Exposure.of([lit])(frames) if len(lit) else frames
    values = np.rint(np.clip(exposed, 0, 1) * 255).astype(np.uint8)
    film = cv2.Animation()
    film.frames = [np.ascontiguousarray(frame[..., ::-1]) for frame in values]
    film.durations = [round(1000 * seconds / len(values))] * len(values)
    with writing(path) as part:
        done, data = cv2.imencodeanimation(".webp", film, [cv2.IMWRITE_WEBP_QUALITY, 85])
        if not done:
            raise OSError(f"{path} cannot be written")
        part.write_bytes(data.tobytes())


def _picture(
    scene: HairScene,
    camera: Camera,
    lights: Sequence[Light],
    maps: Sequence[Environment],
    sampling: Sampling,
) -> Floats:
    total = np.zeros((camera.height, camera.width, 3), np.float32)
    for light in lights:
        total += olat_smoothed(scene, camera, [light], sampling)[0]
    for each in maps:
        total += environment_smoothed(scene, camera, each.envmap, sampling)
    return total

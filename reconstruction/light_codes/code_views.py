"""Input of line stereo: every camera's lines and lightcodes, and its neighbours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from reconstruction.arrays import Bools, Floats
from reconstruction.capture.folder import Capture
from reconstruction.capture.records import CaptureError
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.lights import Light
from reconstruction.images.grey import grey
from reconstruction.images.orientation import orientations
from reconstruction.images.silhouettes import (
    NO_SINGLE_LIGHTS,
    lit_frame,
    noise_of_frames,
)
from reconstruction.light_codes.codes import CodeMap, along_lines, code_map
from reconstruction.reconstruct_options import LogGaborBank
from reconstruction.report.report import Progress, Stage, silent

BESIDE_DEG = 5.0
"""Degrees, from the subject, within which a light counts as beside a camera."""


@dataclass(frozen=True, eq=False)
class View:
    """One camera's hair: `mask (H, W)`, `lines (H, W, 2)` and lightcodes.

    A line is its confidence times (cos θ, sin θ), of arbitrary sign, and 0 outside the mask.
    `beside` is the number of the light beside the camera, -1 without one.
    """

    camera: Camera
    mask: Bools
    lines: Floats
    codes: CodeMap
    beside: int

    @property
    def confidence(self) -> Floats:
        """Confidence `(H, W)` of the lines."""
        return np.hypot(self.lines[..., 0], self.lines[..., 1])


def line_vectors(angle: ArrayLike, confidence: ArrayLike) -> Floats:
    """Lines `(..., 2)` from angles and confidences `(...)`."""
    a, w = np.asarray(angle, float), np.asarray(confidence, float)
    return np.stack([w * np.cos(a), w * np.sin(a)], axis=-1).astype(np.float32)


def light_beside(camera: Camera, lights: Sequence[Light], subject: ArrayLike = (0, 0, 0)) -> int:
    """The light in the direction of the camera from `subject (3,)`, else -1."""
    center = np.asarray(subject, float)
    to = camera.center - center
    away = np.stack([x.position for x in lights]) - center
    lengths = np.linalg.norm(away, axis=1) * np.linalg.norm(to)
    cosine = np.divide(away @ to, lengths, out=np.full(len(away), -1.0), where=lengths > 0)
    best = int(cosine.argmax())
    return best if cosine[best] >= np.cos(np.radians(BESIDE_DEG)) else -1


def nearest_views(views: Sequence[View], subject: ArrayLike, count: int) -> list[list[int]]:
    """For each view, at most `count` others within 90° of it at `subject (3,)`, nearest first."""
    to = np.stack([v.camera.center for v in views]) - np.asarray(subject, float)
    to /= np.maximum(np.linalg.norm(to, axis=1, keepdims=True), 1e-12)
    cosine = to @ to.T
    order = np.argsort(-cosine, axis=1, kind="stable")
    return [
        [int(k) for k in row if k != c and cosine[c, k] > 0][:count] for c, row in enumerate(order)
    ]


def views_of(
    capture: Capture,
    hair: Mapping[str, Bools],
    subject: Any,
    bank: LogGaborBank,
    stage: Stage | None = None,
    progress: Progress = silent,
) -> list[View]:
    """A view for each camera with hair on its mask `hair[name] (H, W)`.

    Frames are scaled to equal irradiance at `subject (3,)`, metres. Without single lights lines
    come from the `lit_frame` and lightcodes are empty. Raises `CaptureError` without either frames,
    or if fewer than two cameras see hair in them.
    """
    stage = stage or Stage("lightcodes")
    names = capture.olat_lights()
    steps = capture.without_single_lights()
    constant = bool(steps)
    if not names and not constant:
        raise CaptureError(
            f"{capture.path}: no OLAT, lit or pattern frames, which lines and lightcodes come from"
        )
    cameras = [c for c in capture.rig.cameras if c.name in hair and hair[c.name].any()]
    steps = steps or capture.of_kind("olat")
    unlit = [c.name for c in cameras if not any(capture.has(s, c.name) for s in steps)]
    if unlit:
        stage.warn(f"{', '.join(unlit)}: no lit frame; not used by line stereo")
        cameras = [c for c in cameras if c.name not in unlit]
    if len(cameras) < 2:
        raise CaptureError(
            f"{capture.path}: hair is on the masks of {[c.name for c in cameras]}: line stereo "
            "needs two cameras that see it; check the masks"
        )
    views = []
    for done, camera in enumerate(cameras):
        progress("lines and lightcodes", done / len(cameras))
        views.append(_view(capture, camera, names, hair[camera.name], subject, bank))
    alone = [v.camera.name for v in views if v.beside < 0]
    stage.figures.update(
        lights=len(names),
        cameras_with_a_light_beside=len(views) - len(alone),
        varying_lights={v.camera.name: int(np.bitwise_count(v.codes.varying).sum()) for v in views},
        threshold={v.camera.name: v.codes.threshold for v in views},
        confidence={v.camera.name: float(np.median(v.confidence[v.mask])) for v in views},
    )
    if constant:
        stage.leave_out("lightcodes", NO_SINGLE_LIGHTS, "visibility and agreement by shadows")
    elif alone:
        stage.warn(
            f"no light is beside {alone}: their visibility comes from their position, not from "
            "lightcodes"
        )
    if not constant and not any(v.codes.varying.any() for v in views):
        stage.warn(
            "all lightcodes are equal, so depths come from lines alone: add single lights that "
            "shadow parts of the hair"
        )
    if not any((v.confidence > 0).any() for v in views):
        raise CaptureError(
            f"{capture.path}: no hair pixel has a direction: are the frames in focus and lit?"
        )
    return views


def _view(
    capture: Capture,
    camera: Camera,
    names: Sequence[str],
    mask: Bools,
    subject: Any,
    bank: LogGaborBank,
) -> View:
    if not names:
        image, saturated = lit_frame(capture, camera.name)
        one = grey(image)[None]
        found = orientations(one, mask, bank, known=~saturated[None])
        codes = code_map(one, mask, 0, noise_of_frames(one), shot=np.zeros(1, bool))
        return View(camera, mask, line_vectors(found.angle, found.confidence), codes, -1)
    at = np.asarray(subject, float)
    lights = [capture.rig.light(n) for n in names]
    images = np.zeros((len(names), camera.height, camera.width), np.float32)
    clipped = np.zeros(images.shape, bool)
    shot = np.array([capture.has_light(n, camera.name) for n in names])
    for i, (name, light) in enumerate(zip(names, lights, strict=True)):
        if not shot[i]:
            continue
        image, clipped[i] = capture.light(name, camera.name)
        irradiance = float(light.irradiance(at).mean())
        if irradiance <= 0:
            raise CaptureError(
                f"{capture.path}: the light {name} has no intensity towards {at.tolist()}: check "
                "its intensity and aim in rig.json"
            )
        images[i] = grey(image) / irradiance
    noise = noise_of_frames(images[shot])
    found = orientations(images[shot], mask, bank, known=~clipped[shot])
    away = [np.linalg.norm(x.position - camera.center) for x in lights]
    furthest = int(np.argmax(np.where(shot, away, -1.0)))
    smooth = along_lines(images, found.angle)
    codes = code_map(smooth, mask, furthest, noise, clipped, shot)
    lines = line_vectors(found.angle, found.confidence)
    return View(camera, mask, lines, codes, light_beside(camera, lights, at))

"""What line stereo looks at: every camera's lines, lightcodes, and who sees what."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from reconstruction.arrays import Bools, Floats
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.lights import Light
from reconstruction.light_codes.codes import CodeMap

BESIDE_DEG = 5.0
"""Degrees, seen from the subject, within which a light counts as standing beside a camera."""


@dataclass(frozen=True, eq=False)
class View:
    """One camera's hair: `mask (H, W)`, `lines (H, W, 2)` and lightcodes.

    A line is its confidence times (cos θ, sin θ); its sign means nothing, and it is 0 outside the
    mask. `beside` is the number of the light that stands beside the camera, -1 where none does.
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


def furthest_light(camera: Camera, lights: Sequence[Light]) -> int:
    """The light furthest from the camera."""
    return int(np.argmax([np.linalg.norm(x.position - camera.center) for x in lights]))


def light_beside(camera: Camera, lights: Sequence[Light], subject: ArrayLike = (0, 0, 0)) -> int:
    """The light that stands where the camera does as seen from `subject (3,)`, else -1."""
    center = np.asarray(subject, float)
    to = camera.center - center
    away = np.stack([x.position for x in lights]) - center
    lengths = np.linalg.norm(away, axis=1) * np.linalg.norm(to)
    cosine = np.divide(away @ to, lengths, out=np.full(len(away), -1.0), where=lengths > 0)
    best = int(cosine.argmax())
    return best if cosine[best] >= np.cos(np.radians(BESIDE_DEG)) else -1


def nearest_views(views: Sequence[View], subject: ArrayLike, count: int) -> list[list[int]]:
    """For each view, the other views by their angle to it as seen from `subject (3,)`.

    Nearest first, at most `count` of them, and none that stands more than a right angle away:
    they see the other side.
    """
    to = np.stack([v.camera.center for v in views]) - np.asarray(subject, float)
    to /= np.maximum(np.linalg.norm(to, axis=1, keepdims=True), 1e-12)
    cosine = to @ to.T
    order = np.argsort(-cosine, axis=1, kind="stable")
    return [
        [int(k) for k in row if k != c and cosine[c, k] > 0][:count] for c, row in enumerate(order)
    ]

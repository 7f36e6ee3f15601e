"""Pictures less their dark frames."""

from __future__ import annotations

import numpy as np

from reconstruction.arrays import Bools, Floats
from reconstruction.capture.folder import Capture, Step
from reconstruction.images.silhouettes import dark_rgb


def dark_response(capture: Capture, step: Step, camera: str) -> tuple[Floats, Bools]:
    """The frame less the dark one, at full level `(H, W, 3)`, and where it is saturated."""
    image, saturated = capture.response_and_saturated(step, camera)
    level = step.level if step.level > 0 else 1.0
    return image - dark_rgb(capture, camera, step.exposure) / np.float32(level), saturated


def light_response(capture: Capture, light: str, camera: str) -> tuple[Floats, Bools]:
    """`Capture.light` less the dark frame, at full level `(H, W, 3)`, and where it is saturated."""
    image, saturated = capture.light(light, camera)
    step = next(s for s in capture.of_kind("olat") if s.light == light)
    level = step.level if step.level > 0 else 1.0
    return image - dark_rgb(capture, camera, step.exposure) / np.float32(level), saturated

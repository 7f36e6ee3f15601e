"""Dark and all-on frames at both ends of a capture: do they show what was commanded?

Counting pulses and block ids cannot see a camera that drops a trigger without a trace or repeats
a frame under a new number. The pictures can: if frames slipped, the last dark frame has light in
it, or the last all-on frame is dark or shows one lamp.
"""

from __future__ import annotations

import numpy as np

from reconstruction import Capture, MissingFrame, Step, read_exr
from reconstruction.arrays import Floats
from stage_service.devices.errors import IndexShift

LEAST_CONTRAST = 8.0
"""Counts by which all-on must exceed dark on the brightest part of the picture."""
BRIGHTEST = 0.1
"""Share of pixels that is compared: those where lamps make the largest difference."""
CHANGED = 0.5
"""Share of the contrast by which a sentinel may differ between begin and end: subjects move."""


def check_sentinels(capture: Capture) -> dict[str, str]:
    """Compare the first and last dark and all-on frames of every camera.

    Returns, by camera, why it could not be compared: frames are missing, or lamps make no
    difference in its picture. Raises `IndexShift` that names every camera whose pictures contradict
    the plan.
    """
    dark, bright = _ends(capture, "dark"), _ends(capture, "all_on")
    if dark is None or bright is None:
        return {}
    unclear, wrong = {}, []
    for camera in capture.rig.cameras:
        try:
            d0, d1, b0, b1 = (_grey(capture, s, camera.name) for s in (*dark, *bright))
        except MissingFrame as error:
            unclear[camera.name] = f"a sentinel frame is missing: {error}"
            continue
        difference = b0 - d0
        look = difference >= np.quantile(difference, 1 - BRIGHTEST)
        contrast = float(difference[look].mean())
        attributes = capture.read_file(bright[0], camera.name, read_exr)[1]
        if contrast < LEAST_CONTRAST * float(attributes.get("countScale", 0.0)):
            unclear[camera.name] = "the lamps make no difference in this camera's picture"
            continue
        shares = [float((x - d0)[look].mean()) / contrast for x in (d1, b1)]
        if abs(shares[0]) > CHANGED or abs(shares[1] - 1) > CHANGED:
            wrong.append(
                f"{camera.name} (dark at the end is {shares[0]:.0%}, all on {shares[1]:.0%} of "
                "what all on was at the beginning)"
            )
    if wrong:
        doing = "comparing the pictures at both ends of the capture"
        expected = "dark frames without light and all-on frames alike"
        todo = "Frames may show other steps, or lamps failed: check the trigger cables and "
        todo += "the lamps, and shoot this capture again."
        raise IndexShift("cameras", doing, expected, "; ".join(wrong), todo)
    return unclear


def _ends(capture: Capture, kind: str) -> tuple[Step, Step] | None:
    steps = [s for s in capture.steps if s.kind == kind]
    return (steps[0], steps[-1]) if len(steps) > 1 else None


def _grey(capture: Capture, step: Step, camera: str) -> Floats:
    """A quarter of the picture in each direction; radiance, mean of the channels."""
    image = capture.frame(step, camera)
    h, w = (max(4 * (n // 4), 1) for n in image.shape[:2])
    small = image[:h, :w].mean(axis=-1)
    if min(h, w) >= 4:
        small = small.reshape(h // 4, 4, w // 4, 4).mean(axis=(1, 3))
    return np.asarray(small, np.float32)

"""OLAT frames of a capture, reduced to the pixels that a fit looks at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from reconstruction.arrays import Bools, Floats, Ints
from reconstruction.capture.folder import Capture, CaptureError
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.lights import Light


@dataclass(frozen=True)
class HeldOut:
    """Cameras and lights that a fit must not see."""

    cameras: tuple[str, ...] = ()
    lights: tuple[str, ...] = ()

    def check(self, capture: Capture) -> None:
        """Raise `CaptureError` where a name is not in the capture, or nothing is left to fit."""
        cameras = [c.name for c in capture.rig.cameras]
        lights = capture.olat_lights()
        for kind, names, known in (
            ("camera", self.cameras, cameras),
            ("light", self.lights, lights),
        ):
            if unknown := sorted(set(names) - set(known)):
                raise CaptureError(f"held-out {kind}s {unknown} are not in {capture.path}")
            if not set(known) - set(names):
                raise CaptureError(f"{capture.path}: every {kind} is held out or none was shot")

    def training_cameras(self, capture: Capture) -> list[str]:
        """Names of the cameras that may be fitted, in rig order."""
        return [c.name for c in capture.rig.cameras if c.name not in self.cameras]

    def training_lights(self, capture: Capture) -> list[str]:
        """Names of the lights that may be fitted, in rig order."""
        return [name for name in capture.olat_lights() if name not in self.lights]


@dataclass(frozen=True, eq=False)
class Observed:
    """One camera's pixels under single lights.

    `pixels (P,)` are flat indices; `radiance (L, P, 3)` in W/(sr m²) at full level; `valid
    (L, P)` is false where the frame is missing or saturated.
    """

    camera: Camera
    lights: tuple[Light, ...]
    pixels: Ints
    radiance: Floats
    valid: Bools

    def where(self, pixels: Bools) -> Observed:
        """The same lights at some of the pixels, marked by `pixels (P,)`."""
        return Observed(
            self.camera,
            self.lights,
            self.pixels[pixels],
            self.radiance[:, pixels],
            self.valid[:, pixels],
        )


def observe(capture: Capture, camera: str, lights: Sequence[str], pixels: Ints) -> Observed:
    """Read the frames of `camera` under each of `lights` and keep `pixels (P,)` of them."""
    radiance = np.zeros((len(lights), len(pixels), 3), np.float32)
    valid = np.zeros((len(lights), len(pixels)), bool)
    for i, name in enumerate(lights):
        if not capture.has_light(name, camera):
            continue
        image, saturated = capture.light(name, camera)
        radiance[i] = image.reshape(-1, 3)[pixels]
        valid[i] = ~saturated.ravel()[pixels]
    return Observed(
        capture.rig.camera(camera),
        tuple(capture.rig.light(name) for name in lights),
        pixels,
        radiance,
        valid,
    )


def chosen(mask: Bools, most: int, rng: np.random.Generator) -> Ints:
    """Flat indices of `most` pixels of `mask` at random, or of all where there are fewer."""
    index = np.flatnonzero(mask)
    return index if len(index) <= most else np.sort(rng.choice(index, most, replace=False))

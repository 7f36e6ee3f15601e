"""OLAT frames of a capture, reduced to the pixels that a fit observes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from reconstruction import Camera, Capture, CaptureError, Light, Model, ModelError
from reconstruction.arrays import Array, Bools, Floats, Ints
from reconstruction.geometry.lights import Lighting


@dataclass(frozen=True)
class HeldOut:
    """Cameras and lights that a fit must not observe."""

    cameras: tuple[str, ...] = ()
    lights: tuple[str, ...] = ()

    def training(self, capture: Capture) -> Capture:
        """`capture` without them: what a fit may observe.

        Raises `CaptureError` where a name is not in the capture, or nothing is left to fit.
        """
        capture.view(cameras=self.cameras)  # raises for unknown names
        out = capture.without_lights(self.lights)
        cameras = [c.name for c in capture.rig.cameras if c.name not in self.cameras]
        if capture.without_single_lights() and not capture.lightings():
            raise CaptureError(
                f"{capture.path}: photographs under constant light do not determine the hair's "
                "appearance: capture an image under each of several lights of known position "
                "(docs/how-to/import.md), or export the strands without a fit"
            )
        for kind, left in (("camera", cameras), ("light", out.lightings())):
            if not left:
                raise CaptureError(f"{capture.path}: every {kind} is held out or none was shot")
        return out.view(cameras=cameras)


@dataclass(frozen=True, eq=False)
class Observed:
    """One camera's pixels under single lights, or patterns of them.

    `pixels (P,)` are flat indices; `radiance (L, P, 3)` in W/(sr m²) at full level; `valid
    (L, P)` is false where the frame is missing or saturated.
    """

    camera: Camera
    lights: tuple[Lighting, ...]
    pixels: Ints
    radiance: Floats
    valid: Bools

    @property
    def single_lights(self) -> tuple[Light, ...]:
        """Those of the lights that are no patterns."""
        return tuple(x for x in self.lights if isinstance(x, Light))

    def where(self, pixels: Bools | Ints) -> Observed:
        """The same lights at some of the pixels, marked by `pixels (P,)`, or by their places."""
        return replace(
            self,
            pixels=self.pixels[pixels],
            radiance=self.radiance[:, pixels],
            valid=self.valid[:, pixels],
        )

    def under(self, lights: Ints) -> Observed:
        """The same pixels under some of the lights, by their indices `(K,)`."""
        return replace(
            self,
            lights=tuple(self.lights[i] for i in lights),
            radiance=self.radiance[lights],
            valid=self.valid[lights],
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
        tuple(capture.lighting(name) for name in lights),
        pixels,
        radiance,
        valid,
    )


def chosen(mask: Bools, most: int, rng: np.random.Generator) -> Ints:
    """Flat indices `(P,)` of `most` pixels of `mask (H, W)` at random, or of all of fewer."""
    index = np.flatnonzero(mask)
    return index if len(index) <= most else np.sort(rng.choice(index, most, replace=False))


def observe_hair(
    capture: Capture, model: Model, lights: Sequence[str], most: int, rng: np.random.Generator
) -> list[Observed]:
    """`most` random hair pixels of each camera of `capture` under `lights`.

    Raises `ModelError` where no camera sees hair.
    """
    seen = []
    for camera in capture.rig.cameras:
        pixels = chosen(model.mask(camera.name, "hair", capture), most, rng)
        if len(pixels):
            seen.append(observe(capture, camera.name, lights, pixels))
    if not seen:
        raise ModelError(f"{model}: the hair masks of the training cameras are all empty")
    return seen


def far_apart(positions: Array, most: int) -> list[int]:
    """Indices of `most` of `positions (N, 3)`, or of all: the first, then the furthest from those.

    The distance is the angle about the origin.
    """
    away = np.linalg.norm(positions, axis=1, keepdims=True)
    towards = positions / np.maximum(away, np.finfo(float).tiny)
    chosen = [0]
    nearest = towards @ towards[0]
    while len(chosen) < min(most, len(positions)):
        nearest[chosen] = np.inf
        chosen.append(int(np.argmin(nearest)))
        nearest = np.maximum(nearest, towards @ towards[chosen[-1]])
    return chosen

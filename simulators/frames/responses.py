"""What the subject answers to each light: rendered once per camera and pose, in its own process."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from appearance.scene.backend import ensure_backend
from reconstruction import Camera, Rig
from reconstruction.arrays import Array, Floats, Ints
from simulators.subject.drift import Drift
from simulators.subject.subject import Subject

if TYPE_CHECKING:
    from appearance import HairScene


@dataclass(frozen=True)
class Quality:
    """Paths per pixel and lights per vertex: what a frame costs and how noisy the truth is.

    `lights` paths serve all lights of a camera at once (see `olat_smoothed`), `sweep` paths all
    rows of a camera and pose, `together` paths one light vector.
    """

    lights: int = 16
    sweep: int = 16
    together: int = 24
    depth: int = 16
    sweep_depth: int = 6

    @classmethod
    def scaled(cls, spp: int) -> Quality:
        """The default proportions with `spp` paths for the lights."""
        return cls(spp, spp, max(1, 3 * spp // 2))


@dataclass(frozen=True, eq=False)
class Response:
    """Radiance at full level of the pixels that see the subject; every other pixel is dark.

    `pixels (P,)` are flat indices, `images (N, P, 3)` in units of `scale`, one for each light or
    row: float32, or float16 for sweeps, whose rounding (0.05 %) is far below a camera's noise.
    """

    pixels: Ints
    images: Floats | NDArray[np.float16]
    scale: float = 1.0

    @classmethod
    def halved(cls, pixels: Ints, images: Floats) -> Response:
        """`images (N, P, 3)` of `pixels (P,)` in half the memory; the brightest value becomes
        1024, far from overflow in sums of it."""
        scale = float(images.max(initial=0.0)) / 1024 or 1.0
        return cls(pixels, (images * np.float32(1 / scale)).astype(np.float16), scale)

    def image(self, index: int) -> Floats:
        """Radiance `(P, 3)` of one light or row."""
        return self.images[index] * np.float32(self.scale)

    def total(self) -> Floats:
        """Radiance `(P, 3)` of all of them together."""
        return self.images.sum(axis=0, dtype=np.float32) * np.float32(self.scale)


class Responder(Protocol):
    """Renders responses; slow calls, one at a time."""

    def lights(self, camera: str) -> Response:
        """The answer at pose 0 to each light alone, `images (L, P, 3)` in the rig's order."""

    def lights_together(self, camera: str, pose: int, power: Array) -> Response:
        """The one answer at `pose`, `images (1, P, 3)`, to all lights at `power (L,)` together."""

    def sweep(self, camera: str, pose: int) -> Mapping[str, Response]:
        """By projector name: the answer at `pose` to each of its rows, `images (rows, P, 3)`."""


def reproducible(
    rig: Rig, subject: Subject, drift: Drift, quality: Quality, seed: int
) -> MitsubaResponder:
    """A `MitsubaResponder` that gives the same bytes every time, for a process of its own.

    Dr.Jit adds floating-point numbers to the film in the order in which its threads come by; with
    one thread that order is fixed. Several such processes use several cores.
    """
    ensure_backend(threads=1)
    return MitsubaResponder(rig, subject, drift, quality, seed)


class MitsubaResponder:
    """Renders with Mitsuba in this process; the scene is built at the first call.

    A moved subject is rendered as the unmoved one under moved cameras, lights and projectors, so
    one acceleration structure serves all poses.
    """

    def __init__(
        self, rig: Rig, subject: Subject, drift: Drift, quality: Quality, seed: int
    ) -> None:
        self._rig, self._subject, self._drift = rig, subject, drift
        self._quality, self._seed = quality, seed

    def lights(self, camera: str) -> Response:
        """See `Responder.lights`."""
        from appearance import Sampling
        from appearance.render.smoothed import olat_smoothed

        seen, pixels = self._view(camera, 0)
        paths = Sampling(self._quality.lights, self._quality.depth, self._seeds(camera, 0, 1))
        images = olat_smoothed(self._scene, seen, self._rig.lights, paths, pixels=pixels)
        return Response(pixels, images)

    def lights_together(self, camera: str, pose: int, power: Array) -> Response:
        """See `Responder.lights_together`; `power (L,)`. A vertex asks a sample of them."""
        from appearance import render_olat

        seen, pixels = self._view(camera, pose)
        rotation, translation = self._drift.pose(pose)
        lit = [
            replace(light.moved(rotation, translation), intensity=light.intensity * share)
            for light, share in zip(self._rig.lights, power, strict=True)
            if share > 0
        ]
        images = render_olat(
            self._scene,
            seen,
            lit,
            spp=self._quality.together,
            max_depth=self._quality.depth,
            seed=self._seeds(camera, pose, 2),
            pixels=pixels,
            first_lights=8,
            deep_lights=2,
        )
        return Response(pixels, images.sum(axis=0, keepdims=True))

    def sweep(self, camera: str, pose: int) -> dict[str, Response]:
        """See `Responder.sweep`."""
        from appearance import render_scanlines

        seen, pixels = self._view(camera, pose)
        rotation, translation = self._drift.pose(pose)
        rows = render_scanlines(
            self._scene,
            seen,
            [p.moved(rotation, translation) for p in self._rig.projectors],
            spp=self._quality.sweep,
            max_depth=self._quality.sweep_depth,
            seed=self._seeds(camera, pose, 3),
            pixels=pixels,
        )
        return {name: Response.halved(pixels, images) for name, images in rows.items()}

    @cached_property
    def _scene(self) -> HairScene:
        from appearance import build_scene

        s = self._subject
        return build_scene(s.strands, s.head, hair=s.hair, skin=s.skin)

    def _view(self, camera: str, pose: int) -> tuple[Camera, Ints]:
        from appearance.render.coverage import covered_pixels

        seen = self._rig.camera(camera).moved(*self._drift.pose(pose))
        return seen, covered_pixels(self._scene, seen)

    def _seeds(self, camera: str, pose: int, what: int) -> int:
        """Each picture its own paths: noise that all poses shared would look like structure."""
        index = [c.name for c in self._rig.cameras].index(camera)
        sequence = np.random.SeedSequence([self._seed, index, pose, what])
        return int(sequence.generate_state(1)[0])

"""Responses of the subject to each light, rendered once per camera and pose."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from appearance.scene.backend import ensure_backend
from reconstruction import Camera, Rig
from reconstruction.arrays import Array, Floats, Ints
from reconstruction.report.report import free_memory
from simulators.subject.drift import Drift
from simulators.subject.subject import Subject

if TYPE_CHECKING:
    from appearance import HairScene


PROCESS_GB = 0.27
"""Of Python, Mitsuba and LLVM."""


@dataclass(frozen=True)
class Quality:
    """Paths per pixel and lights per vertex, which determine cost and noise of frames.

    `lights` paths are shared by all lights of a camera (see `olat_smoothed`), `sweep` paths by all
    rows of a camera and pose; `together` paths are for one light vector.
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
    """Radiance at full level of the pixels that show the subject; other pixels are dark.

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
    """Renders responses; calls are slow and not concurrent."""

    def lights(self, camera: str) -> Response:
        """The response at pose 0 to each light, `images (L, P, 3)` in the rig's order."""

    def lights_together(self, camera: str, pose: int, power: Array) -> Response:
        """The response at `pose`, `images (1, P, 3)`, to all lights at `power (L,)`."""

    def sweep(self, camera: str, pose: int) -> Mapping[str, Response]:
        """By projector name: the response at `pose` to each of its rows, `images (rows, P, 3)`."""


def reproducible(
    rig: Rig, subject: Subject, drift: Drift, quality: Quality, seed: int
) -> MitsubaResponder:
    """A `MitsubaResponder` with reproducible bytes, for a separate process.

    Dr.Jit's sums depend on the order of its threads, so it gets one; several processes use several
    cores.
    """
    ensure_backend(threads=1)
    return MitsubaResponder(rig, subject, drift, quality, seed)


def frames_memory(rig: Rig, subject: Subject) -> float:
    """Approximate GB of a process that renders cameras of `rig` under each of its lights."""
    from appearance.inverse_rendering.memory import scene_memory
    from appearance.render.smoothed import memory_needed

    points, images = subject.strands.points, [0.0]
    for camera in rig.cameras:
        pixel, depth = camera.project(points)
        shown = pixel[(depth > 0) & camera.inside(pixel)].astype(np.float32)
        area = cv2.contourArea(cv2.convexHull(shown)) if len(shown) else 0.0
        images.append(memory_needed(camera, round(area), len(rig.lights)))
    mapped = subject.absorption is not None
    return PROCESS_GB + scene_memory(len(points), max(images), mapped=mapped)


def check_memory(rig: Rig, subject: Subject, processes: int) -> None:
    """Raise `ValueError` if so many rendering processes need more memory than is free."""
    count, free = min(processes, len(rig.cameras)), free_memory()
    needed = count * frames_memory(rig, subject)
    if free is not None and needed > free:
        raise ValueError(
            f"frames of {len(rig.lights)} lights take about {needed:.1f} GB of memory in {count} "
            f"rendering processes, and {free:.1f} GB are free: use fewer --processes, strands or "
            "lights, or smaller cameras"
        )


class MitsubaResponder:
    """Renders with Mitsuba in this process; the scene is built at the first call.

    A moved subject is rendered by moving cameras, lights and projectors, so all poses share one
    acceleration structure.
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

        view, pixels = self._view(camera, 0)
        paths = Sampling(self._quality.lights, self._quality.depth, self._seeds(camera, 0, 1))
        images = olat_smoothed(self._scene, view, self._rig.lights, paths, pixels=pixels)
        return Response(pixels, images)

    def lights_together(self, camera: str, pose: int, power: Array) -> Response:
        """See `Responder.lights_together`; `power (L,)`. Vertices sample some of them."""
        from appearance import render_olat

        view, pixels = self._view(camera, pose)
        rotation, translation = self._drift.pose(pose)
        lit = [
            replace(light.moved(rotation, translation), intensity=light.intensity * share)
            for light, share in zip(self._rig.lights, power, strict=True)
            if share > 0
        ]
        images = render_olat(
            self._scene,
            view,
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

        view, pixels = self._view(camera, pose)
        rotation, translation = self._drift.pose(pose)
        rows = render_scanlines(
            self._scene,
            view,
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
        from appearance.bsdf.maps import HairMaps, MappedStrands

        s = self._subject
        scene = build_scene(s.strands, s.head, hair=s.hair, skin=s.skin)
        if s.dressed is not None:
            mesh, materials = s.dressed.mesh, s.dressed.materials
            scene = build_scene(s.strands, mesh, hair=s.hair, materials=materials)
        if s.absorption is None:
            return scene
        return MappedStrands.alone(scene, s.strands).with_maps(HairMaps.each(s.hair, s.absorption))

    def _view(self, camera: str, pose: int) -> tuple[Camera, Ints]:
        from appearance.render.coverage import covered_pixels

        view = self._rig.camera(camera).moved(*self._drift.pose(pose))
        return view, covered_pixels(self._scene, view)

    def _seeds(self, camera: str, pose: int, what: int) -> int:
        """A seed per image: noise shared by all poses would look like structure."""
        index = [c.name for c in self._rig.cameras].index(camera)
        sequence = np.random.SeedSequence([self._seed, index, pose, what])
        return int(sequence.generate_state(1)[0])

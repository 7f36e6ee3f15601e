"""Hair pixels of captured frames under single lights: a reflectance field."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from reconstruction import Camera, Capture, Light, Progress, silent
from reconstruction.arrays import AnyFloats, Floats, Ints
from reconstruction.files.durable import require_free, writing

Halves = NDArray[np.float16]
_LARGEST = 6e4
"""Largest sample; the largest half is 65,504."""


@dataclass(frozen=True, eq=False)
class CapturedView:
    """A captured camera's hair pixels, `pixels (P,)` flat indices, under L lights.

    `table (L, P, 3)`, in memory or mapped from a file, is the radiance at full level times an
    exposure, NaN where missing or saturated.
    """

    camera: Camera
    pixels: Ints
    table: Halves

    def under(self, lights: Ints) -> Floats:
        """The samples under the lights of numbers `lights (k,)`: `(k, P, 3)`."""
        return self.table[lights].astype(np.float32)

    def index(self, points: AnyFloats) -> Ints:
        """Numbers `(...)` of the pixels that world `points (..., 3)` project to, -1 for others;
        without a test of occlusion."""
        number = np.full(self.camera.width * self.camera.height, -1)
        number[self.pixels] = np.arange(len(self.pixels))
        inside, x, y, _ = self.camera.pixels_of(points.reshape(-1, 3))
        found = np.where(inside, number[y * self.camera.width + x], -1)
        return np.asarray(found.reshape(points.shape[:-1]))


@dataclass(frozen=True, eq=False)
class ReflectanceField:
    """All `views` of a capture under single `lights` (Photobooth §4); samples are radiance times
    `scale`, found by projection of points on strands."""

    lights: tuple[Light, ...]
    views: tuple[CapturedView, ...]
    scale: float

    @property
    def bytes(self) -> int:
        """Size of the tables."""
        return sum(view.table.nbytes for view in self.views)


def gather(
    capture: Capture,
    pixels: Mapping[str, Ints],
    scale: float,
    *,
    folder: Path | None = None,
    progress: Progress = silent,
) -> ReflectanceField:
    """Read the frames of `capture`'s single lights at the flat `pixels (P,)` of each named camera.

    `scale` multiplies radiance so that halves hold it: white becomes about 1. With a `folder` each
    camera's table is a memory-mapped file, reused for the same frames, lights, pixels and scale.
    `progress` is called at every frame, and may raise to stop. Raises `DiskFull` before a table
    without room.
    """
    names = capture.olat_lights()
    cameras = [c for c in capture.rig.cameras if len(pixels.get(c.name, ()))]
    views = []
    for k, camera in enumerate(cameras):

        def of_camera(what: str, share: float, done: int = k) -> None:
            progress(what, (done + share) / len(cameras))

        index = np.asarray(pixels[camera.name], np.int64)
        views.append(_view(_Frames(capture, camera, names, index, scale), folder, of_camera))
    return ReflectanceField(tuple(capture.rig.light(n) for n in names), tuple(views), scale)


@dataclass(frozen=True, eq=False)
class _Frames:
    """The frames of one camera."""

    capture: Capture
    camera: Camera
    names: Sequence[str]
    index: Ints
    scale: float

    def read(self, out: Halves, progress: Progress) -> None:
        """Fill `out (L, P, 3)`."""
        name = self.camera.name
        for i, light in enumerate(self.names):
            progress(f"reading frames of {name}", i / len(self.names))
            out[i] = np.nan
            if not self.capture.has_light(light, name):
                continue
            image, saturated = self.capture.light(light, name)
            values = image.reshape(-1, 3)[self.index] * np.float32(self.scale)
            known = ~saturated.ravel()[self.index] & np.isfinite(values).all(axis=1)
            out[i, known] = np.minimum(values[known], np.float32(_LARGEST))

    def fingerprint(self) -> str:
        """A hash of all that the table depends on."""
        known = hashlib.sha256(repr((self.camera.to_dict(), list(self.names), self.scale)).encode())
        for step in self.capture.of_kind("olat"):
            record = self.capture.records.get((step.index, self.camera.name))
            known.update(repr((step, record and record.sha256)).encode())
        known.update(self.index.tobytes())
        return known.hexdigest()[:16]


def _view(frames: _Frames, folder: Path | None, progress: Progress) -> CapturedView:
    shape = (len(frames.names), len(frames.index), 3)
    if folder is None:
        table: Halves = np.empty(shape, np.float16)
        frames.read(table, progress)
        return CapturedView(frames.camera, frames.index, table)
    name = frames.camera.name
    file = folder / f"{name}-{frames.fingerprint()}.npy"
    if not file.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        for old in folder.glob(f"{name}-????????????????.npy"):
            old.unlink()
        require_free(folder, 2 * int(np.prod(shape)))
        with writing(file) as part:
            made = np.lib.format.open_memmap(part, "w+", np.float16, shape)
            frames.read(made, progress)
            made.flush()
    return CapturedView(frames.camera, frames.index, np.load(file, mmap_mode="r"))

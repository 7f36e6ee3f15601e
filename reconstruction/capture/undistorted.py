"""A capture read as if its lenses bent no lines."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike

from reconstruction.arrays import Array, Bools, Floats
from reconstruction.capture.folder import Capture, Step
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.rig import Rig
from reconstruction.report.report import Report

Maps = tuple[Floats, Floats]


@dataclass(frozen=True, eq=False)
class _Lens:
    """One camera's way between its pictures `bent` and `straight`.

    `to_bent` are the places (x, y), each `(H, W)` of the straight picture, in the bent one;
    `to_straight` the other way round.
    """

    bent: Camera
    straight: Camera
    to_bent: Maps
    to_straight: Maps

    @classmethod
    def of(cls, bent: Camera) -> _Lens:
        """The straight picture is the largest upright one without a pixel the bent one lacks.

        Its scale is that of the bent picture's middle, so that no detail there is lost.
        """
        pinhole = replace(bent, distortion=np.zeros(5))
        x, y = np.arange(bent.width), np.arange(bent.height)
        x0 = int(np.ceil(_moved(bent, pinhole, 0, y)[0].max()))
        x1 = int(np.floor(_moved(bent, pinhole, bent.width - 1, y)[0].min()))
        y0 = int(np.ceil(_moved(bent, pinhole, x, 0)[1].max()))
        y1 = int(np.floor(_moved(bent, pinhole, x, bent.height - 1)[1].min()))
        K = bent.K.copy()
        K[:2, 2] -= x0, y0
        straight = replace(pinhole, K=K, width=x1 - x0 + 1, height=y1 - y0 + 1)
        return cls(bent, straight, _grid(straight, bent), _grid(bent, straight))

    def straighten(self, image: Floats) -> Floats:
        """A bent picture `(H, W, C)`, straight, by cubic interpolation.

        Beside the last of the light a cubic swings below zero, which would pass for noise: what is
        below zero stays within the four pixels around it.
        """
        x, y = self.to_bent
        image = np.ascontiguousarray(image, dtype=np.float32)
        out = cv2.remap(image, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        least = cv2.erode(image, np.ones((2, 2), np.uint8), anchor=(1, 1))  # of these and before
        least = cv2.remap(least, np.ceil(x), np.ceil(y), cv2.INTER_NEAREST)
        return np.maximum(out, np.minimum(least, 0)).reshape(*x.shape, -1)


def _moved(source: Camera, target: Camera, x: ArrayLike, y: ArrayLike) -> tuple[Array, Array]:
    """Where pixels of `source` are in the picture of `target`, which stands in the same place."""
    pixels = np.stack(np.broadcast_arrays(x, y), axis=-1)
    moved, _ = target.project(target.center + source.rays(pixels))
    return moved[..., 0], moved[..., 1]


def _grid(source: Camera, target: Camera) -> Maps:
    x, y = np.meshgrid(np.arange(source.width), np.arange(source.height))
    u, v = _moved(source, target, x, y)
    return u.astype(np.float32), v.astype(np.float32)


class StraightenedCapture(Capture):
    """`source` with pinhole cameras: its frames and masks are resampled as they are read."""

    def __init__(self, source: Capture) -> None:
        self.__dict__.update(source.__dict__)
        self.source = source
        self._lenses = {c.name: _Lens.of(c) for c in source.rig.cameras if c.distorted}
        rig = source.rig
        cameras = tuple(self._lenses[c.name].straight if c.distorted else c for c in rig.cameras)
        self.rig = Rig(rig.name, cameras, rig.lights, rig.projectors)

    def frame(self, step: Step, camera: str) -> Floats:
        image = self.source.frame(step, camera)
        lens = self._lenses.get(camera)
        return image if lens is None else lens.straighten(image)

    def response_and_saturated(self, step: Step, camera: str) -> tuple[Floats, Bools]:
        image, saturated = self.source.response_and_saturated(step, camera)
        lens = self._lenses.get(camera)
        if lens is None:
            return image, saturated
        return lens.straighten(image), _touched(saturated, lens.to_bent)

    def mask(self, camera: str) -> Bools | None:
        mask = self.source.mask(camera)
        return None if mask is None else self.straight(camera, mask)

    def straight(self, camera: str, mask: Bools) -> Bools:
        """A mask in the pixels of the capture's own pictures, in those of the straight one."""
        lens = self._lenses.get(camera)
        return mask if lens is None else _looked_up(mask, lens.to_bent)

    def as_shot(self, camera: str, mask: Bools) -> Bools:
        """The inverse of `straight`."""
        lens = self._lenses.get(camera)
        return mask if lens is None else _looked_up(mask, lens.to_straight)

    def kept(self) -> dict[str, float]:
        """The share of the pixels of each camera with a lens that the straight picture shows."""
        out = {}
        for name, lens in self._lenses.items():
            pixels = np.stack(lens.to_straight, axis=-1)
            out[name] = float(lens.straight.inside(pixels).mean())
        return out


def straightened(capture: Capture, report: Report) -> Capture:
    """The capture itself where no lens bends lines, else one that is read through pinholes.

    The stage "lenses" says how much of each picture is left: the straight one is upright.
    """
    report.stages = [s for s in report.stages if s.name != "lenses"]
    if not any(c.distorted for c in capture.rig.cameras):
        return capture
    with report.stage("lenses") as stage:
        out = StraightenedCapture(capture)
        stage.figures["pixels_kept"] = out.kept()
        for name, share in out.kept().items():
            if share < 0.85:
                stage.warn(f"{name}: {1 - share:.0%} of the picture lie outside the straight one")
    return out


def as_shot(capture: Capture, camera: str, mask: Bools) -> Bools:
    """A mask that was made of `capture`, in the pixels of the frames on disk."""
    return capture.as_shot(camera, mask) if isinstance(capture, StraightenedCapture) else mask


def _looked_up(mask: Bools, maps: Maps) -> Bools:
    weight = cv2.remap(mask.astype(np.float32), *maps, cv2.INTER_LINEAR)
    return np.asarray(weight >= 0.5)


def _touched(mask: Bools, maps: Maps) -> Bools:
    weight = cv2.remap(mask.astype(np.float32), *maps, cv2.INTER_LINEAR)
    return np.asarray(weight > 0)

"""The fibres visible in a camera's pixels, and their directions."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from appearance.render.paths import Surface, jittered, pixel_indices, stream
from appearance.scene.hair_scene import SCALE, HairScene
from reconstruction import Camera
from reconstruction.array_backend import for_kernels, rows_of
from reconstruction.arrays import Array, Bools, Floats, Ints


@dataclass(frozen=True, eq=False)
class VisibleFibres:
    """The first hits of `K` rays through each of `P` pixels.

    `point (P, K, 3)` in metres; `tangent (P, K, 3)`, unit, root to tip; `hair (P, K)` marks the
    rays that meet a fibre: where it is false, the other two are 0.
    """

    point: Floats
    tangent: Floats
    hair: Bools

    @property
    def share(self) -> Array:
        """Share of each pixel that shows hair `(P,)`."""
        return np.asarray(self.hair.mean(axis=1))

    def mean_tangent(self) -> Array:
        """Unit mean of each pixel's tangents `(P, 3)`; 0 where it shows no hair."""
        mean = self.tangent.sum(axis=1, dtype=float)
        return np.asarray(mean / np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12))

    def where(self, pixels: Bools | Ints) -> VisibleFibres:
        """Those of some of the pixels, marked by `pixels (P,)`, or by their places."""
        return VisibleFibres(self.point[pixels], self.tangent[pixels], self.hair[pixels])

    def spread(self) -> Array:
        """Variance `(P,)`, rad², of the tangents' angle to their undirected mean in a pixel."""
        t = self.tangent.astype(float)
        count = np.maximum(self.hair.sum(axis=1), 1)
        scatter = np.einsum("pki,pkj->pij", t, t) / count[:, None, None]
        return np.where(self.hair.any(axis=1), 1.0 - np.linalg.eigvalsh(scatter)[:, -1], 0.0)


def visible_fibres(
    scene: HairScene, camera: Camera, pixels: ArrayLike, *, samples: int = 16, seed: int = 0
) -> VisibleFibres:
    """Trace `samples` jittered rays through each of `pixels (P,)` (flat indices) of `camera`."""
    index = pixel_indices(camera, pixels)
    if samples < 1:
        raise ValueError(f"samples must be positive, got {samples}")
    count = len(index) * samples
    if count == 0:
        empty = np.zeros((len(index), samples, 3), np.float32)
        return VisibleFibres(empty, empty.copy(), np.zeros((len(index), samples), bool))
    lane = dr.arange(mi.UInt32, count)
    slot = lane // samples
    sample = lane - slot * samples
    pixel = dr.gather(mi.UInt32, mi.UInt32(for_kernels(index, np.uint32)), slot)
    ray = jittered(camera, pixel, sample, samples, stream(count, seed))
    surface = Surface(scene)
    si = surface.interact(ray, mi.Bool(True))
    hair = si.is_valid() & surface.is_hair(si)
    tangent = dr.select(hair, si.sh_frame.t, 0)  # Mitsuba's fibres run along y of their frame
    point = dr.select(hair, si.p / SCALE, 0)
    shape = (len(index), samples, 3)
    dr.eval(point, tangent, hair)  # one tracing for the three
    return VisibleFibres(
        rows_of(point).reshape(shape),
        rows_of(tangent).reshape(shape),
        np.array(hair, dtype=bool).reshape(shape[:2]),
    )

"""The baseline: line stereo without lightcodes, after Nam et al. 2019 as Sun §4 describes it.

Depth and direction are searched together; the cost is the angle between projected and observed
lines over the better half of the nearest cameras, as visibility is unknown.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
from numpy.typing import NDArray

from reconstruction.array_backend import for_kernels
from reconstruction.arrays import Bools, Floats, Ints
from reconstruction.light_codes.device_views import DeviceViews
from reconstruction.light_codes.objective import Pixels, line_through
from reconstruction.light_codes.search import LENGTH, SAMPLES, DepthSearch, fetched

FAN = np.radians(np.linspace(-50, 50, 5))
"""Inclinations towards the camera that are tried at every depth."""

COARSE_SAMPLES, COARSE_NEIGHBOURS = 3, 6
ROUNDS = 3


class LmvsSearch(DepthSearch):
    """Searches depth and inclination; same inputs and outputs as `DepthSearch`."""

    def visible(self, view: int, y: Ints, x: Ints) -> Bools:
        """All neighbours `(P, N)`."""
        return np.ones((len(x), len(self.neighbours[view])), bool)

    def search(
        self, pixels: Pixels, x: Any, y: Any, start: Floats, counts: NDArray[np.uint32], view: int
    ) -> tuple[Any, ...]:
        """As `DepthSearch.search`; the agreement `(P,)` is 1 less the cost over a right angle."""
        t = self.types
        pixels.code = []  # no lightcodes: all count as equal
        along = self._in_plane(view, x, y)
        near, number = t.Float(for_kernels(start)), t.UInt32(for_kernels(counts, np.uint32))
        step, samples = dr.opaque(t.Float, self.steps[view]), dr.opaque(t.UInt32, SAMPLES)
        total = len(self.neighbours[view])
        few = min(COARSE_NEIGHBOURS, total)
        coarse = _Cost(self.device, pixels, along, few, LENGTH)
        cost, depth, tilt = _sweep(coarse, near, step, number)
        fine = _Cost(self.device, pixels, along, total, LENGTH)
        cost = fine(depth, tilt, samples)
        move, turn = 0.5 * self.steps[view], 0.5 * float(FAN[1] - FAN[0])
        for _ in range(ROUNDS):
            for dz, da in ((move, 0.0), (-move, 0.0), (0.0, turn), (0.0, -turn)):
                d, a = depth + dr.opaque(t.Float, dz), tilt + dr.opaque(t.Float, da)
                here = fine(d, a, samples)
                better = here < cost
                cost = dr.select(better, here, cost)
                depth, tilt = dr.select(better, d, depth), dr.select(better, a, tilt)
                dr.eval(cost, depth, tilt)
            move, turn = 0.5 * move, 0.5 * turn
        line = line_through(self.device, pixels, pixels.at(depth))
        depth, direction, cost, spread, misfit = fetched(depth, along(tilt), cost, line)
        return depth, direction, 1 - cost / np.float32(np.pi / 2), spread, misfit

    def _in_plane(self, view: int, x: Ints, y: Ints) -> Any:
        """A function from inclinations to unit directions in the plane of each pixel's line."""
        own, t = self.views[view], self.types
        pixel = np.stack([x, y], axis=1).astype(float)
        line = own.lines[y, x].astype(float)
        line /= np.linalg.norm(line, axis=1, keepdims=True)
        ray = own.camera.rays(pixel)
        across = own.camera.rays(pixel + line) - ray
        across -= (across * ray).sum(axis=1, keepdims=True) * ray
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        a, r = (t.Array3f(*(t.Float(for_kernels(c)) for c in v.T)) for v in (across, ray))
        return lambda tilt: dr.cos(tilt) * a + dr.sin(tilt) * r


class _Cost:
    """Mean angle, over the better half of the nearest `count` views, of a line at a depth."""

    def __init__(
        self, views: DeviceViews, pixels: Pixels, along: Any, count: int, length: float
    ) -> None:
        self.views, self.pixels, self.along = views, pixels, along
        self.count = count
        self.kept = max(1, count // 2)
        self.length = dr.opaque(views.types.Float, length)

    def __call__(self, depth: Any, tilt: Any, samples: Any) -> Any:
        apart = self.length / dr.maximum(self.views.types.Float(samples) - 1, 1)
        direction = apart * self.along(tilt)
        best = self._best_angles(self.pixels.at(depth), direction, samples)
        return sum(best) / self.kept

    @dr.syntax
    def _best_angles(self, point: Any, along: Any, samples: Any) -> list[Any]:
        """The `kept` smallest mean angles among the neighbours, a right angle where no line is."""
        views, t = self.views, self.views.types
        best = [t.Float(np.pi / 2) for _ in range(self.kept)]
        count = dr.opaque(t.UInt32, self.count + 1)
        n = t.UInt32(1)
        while n < count:
            view = dr.gather(t.UInt32, self.pixels.neighbours, n)
            middle = views.projection(view, point, 1)
            step = views.projection(view, along, 0)
            frame = views.corner(view)
            h = middle - 0.5 * (t.Float(samples) - 1) * step
            angle = t.Float(0)
            s = t.UInt32(0)
            while s < samples:
                at = views.sample(frame, [], [], h, t.Bool(True))
                ux, uy = step.x - at.x * step.z, step.y - at.y * step.z
                norm = (ux * ux + uy * uy) * (at.lx * at.lx + at.ly * at.ly)
                cosine = dr.abs(ux * at.lx + uy * at.ly) * dr.rsqrt(dr.maximum(norm, 1e-20))
                angle += dr.select(at.there, dr.acos(dr.minimum(cosine, 1)), np.pi / 2)
                h += step
                s += 1
            here = angle / t.Float(samples)
            for i in range(self.kept):
                better = here < best[i]
                old = best[i]
                best[i] = dr.select(better, here, old)
                here = dr.select(better, old, here)
            n += 1
        return best


@dr.syntax
def _sweep(cost: _Cost, near: Any, step: Any, number: Any) -> tuple[Any, Any, Any]:
    """The least cost over all depths and the fan's inclinations, with its depth and inclination."""
    t = cost.views.types
    fan, tilts = t.Float(for_kernels(FAN)), len(FAN)
    samples = dr.opaque(t.UInt32, COARSE_SAMPLES)
    least, depth, tilt = t.Float(np.inf), t.Float(near), t.Float(0)
    k = t.UInt32(0)
    while k < number:
        d = near + step * t.Float(k)
        i = t.UInt32(0)
        while i < tilts:
            a = dr.gather(t.Float, fan, i)
            here = cost(d, a, samples)
            better = here < least
            least = dr.select(better, here, least)
            depth, tilt = dr.select(better, d, depth), dr.select(better, a, tilt)
            i += 1
        k += 1
    return least, depth, tilt

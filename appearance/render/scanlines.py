"""Scanline sweeps: every row of every projector from one set of camera paths."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from appearance.render.coverage import covered_pixels
from appearance.render.paths import (
    Surface,
    Wave,
    each_sample,
    light_from,
    opaque,
    opaque_index,
    opaque_matrix,
    pixel_indices,
    walk,
)
from appearance.scene import SCALE, HairScene
from reconstruction.cameras import Camera
from reconstruction.projectors import Projector

_PILOT = 512  # pixels of the pilot pass
_PILOT_STREAM = 1 << 31
_REACH = 4.0  # standard deviations of the line's blur beyond which a row is not asked


def render_scanlines(
    scene: HairScene,
    camera: Camera,
    projectors: Sequence[Projector],
    *,
    spp: int = 16,
    max_depth: int = 4,
    seed: int = 0,
    pixels: ArrayLike | None = None,
    rows: Mapping[str, range] | None = None,
    rr_depth: int = 3,
    thrift: float = 0.25,
) -> dict[str, NDArray[np.float32]]:
    """Radiance of each row of each projector at full level, W/(sr m²).

    Returns by projector name `(rows, H, W, 3)`, or `(rows, P, 3)` for `pixels (P,)` (flat
    indices). Every vertex of a camera path that a projector sees lies on one fractional row of it:
    its light goes to the few rows within reach of the line's blur (`Projector.row_weight`), so one
    pass answers the whole sweep. The sum over all rows is that projector with all rows on.
    Roulette of shadow rays (`thrift`) and of paths (`rr_depth`) as in `render_olat`.
    `rows` limits a projector to a range of its rows. A moved subject is rendered with the camera
    and the projectors `moved` instead: the scene stays as it is.
    """
    if spp < 1 or max_depth < 1:
        raise ValueError(f"spp and max_depth must be positive, got {spp}, {max_depth}")
    names = [p.name for p in projectors]
    ranges = {p.name: _rows(p, (rows or {}).get(p.name)) for p in projectors}
    if unknown := set(rows or {}) - set(names):
        raise ValueError(f"rows names unknown projectors {sorted(unknown)}; there are {names}")
    index = covered_pixels(scene, camera) if pixels is None else pixel_indices(camera, pixels)
    plan = _Plan(projectors, ranges, max_depth, rr_depth, (0.0,) * len(projectors))
    if thrift > 0 and len(index):
        plan = replace(plan, dim=_dim(scene, camera, index, plan, seed, thrift))
    films = _render(scene, camera, index, plan, spp, (seed, 0))
    if pixels is not None:
        return films
    out = {}
    for name, film in films.items():
        image = np.zeros((len(film), camera.height * camera.width, 3), np.float32)
        image[:, index] = film
        out[name] = image.reshape(len(film), camera.height, camera.width, 3)
    return out


def _rows(projector: Projector, rows: range | None) -> range:
    wanted = range(projector.height) if rows is None else rows
    if wanted.step != 1 or (wanted and (wanted[0] < 0 or wanted[-1] >= projector.height)):
        raise ValueError(
            f"{projector.name}: rows must be a range of step 1 in [0, {projector.height}), "
            f"got {wanted}"
        )
    return wanted


@dataclass(frozen=True)
class _Plan:
    """What is swept, and how paths and shadow rays are spent; `dim` as in `light_from`."""

    projectors: Sequence[Projector]
    rows: dict[str, range]
    max_depth: int
    rr_depth: int
    dim: tuple[float, ...]


def _dim(
    scene: HairScene,
    camera: Camera,
    index: NDArray[np.int64],
    plan: _Plan,
    seed: int,
    thrift: float,
) -> tuple[float, ...]:
    """`thrift` times the mean radiance under each projector, from a few paths."""
    few = index[:: max(1, len(index) // _PILOT)]
    films = _render(scene, camera, few, plan, 1, (seed, _PILOT_STREAM))
    return tuple(thrift * float(f.sum(0).mean(0).max(initial=0.0)) for f in films.values())


def _render(
    scene: HairScene,
    camera: Camera,
    index: NDArray[np.int64],
    plan: _Plan,
    spp: int,
    seed: tuple[int, int],
) -> dict[str, NDArray[np.float32]]:
    """Mean over `spp` paths a pixel: `(rows, P, 3)` by projector."""
    import drjit as dr
    import mitsuba as mi

    projectors, ranges = plan.projectors, plan.rows
    n = len(index)
    if n == 0:
        return {p.name: np.zeros((len(ranges[p.name]), 0, 3), np.float32) for p in projectors}
    films = [dr.zeros(mi.Float, 3 * len(ranges[p.name]) * n) for p in projectors]
    pixel = mi.UInt32(index.astype(np.uint32))
    surface = Surface(scene)
    slots = opaque_index(n)

    def trace(paths: Wave) -> None:
        gathers = [
            _Gather(surface, film, paths.slot, slots, p, ranges[p.name], dim)
            for p, film, dim in zip(projectors, films, plan.dim, strict=True)
        ]

        def gather(si: Any, throughput: Any, rng: Any, first: bool, active: Any) -> None:
            for one in gathers:
                one(si, throughput, rng.next_float32(), active)

        walk(surface, paths.rays, paths.rng, gather, plan.max_depth, plan.rr_depth)

    each_sample(camera, pixel, n, spp, seed, trace)
    return {
        p.name: np.array(film, dtype=np.float32).reshape(len(ranges[p.name]), n, 3)
        / np.float32(spp)
        for p, film in zip(projectors, films, strict=True)
    }


@dataclass(frozen=True)
class _Gather:
    """One projector's light at a path's vertex, split over its rows."""

    surface: Surface
    film: Any
    slot: Any
    slots: Any
    projector: Projector
    rows: range
    dim: float

    def __call__(self, si: Any, throughput: Any, chance: Any, active: Any) -> None:
        import mitsuba as mi

        if not self.rows:
            return
        p = self.projector
        centre = mi.Point3f(*opaque(p.center * SCALE))
        local = opaque_matrix(p.R) @ (si.p - centre)
        x, y = local.x / local.z, local.y / local.z
        k = opaque([p.K[0, 0], p.K[0, 1], p.K[0, 2], p.K[1, 1], p.K[1, 2], p.width - 0.5])
        u = k[0] * x + k[1] * y + k[2]
        v = k[3] * y + k[4]
        reach = _REACH * p.line_sigma + 0.5
        low, high = opaque([self.rows.start - reach, self.rows.stop - 1 + reach])
        seen = active & (local.z > 0) & (u >= -0.5) & (u < k[5]) & (v > low) & (v < high)
        intensity = mi.Color3f(*opaque(p.intensity * SCALE**2))
        (dim,) = opaque(self.dim)
        value, seen = light_from(self.surface, si, throughput, centre, intensity, dim, chance, seen)
        self._splat(value, v, reach, seen)

    def _splat(self, value: Any, v: Any, reach: float, seen: Any) -> None:
        """Add `value` to the rows near `v`, weighted as `Projector.row_weight` does."""
        import drjit as dr
        import mitsuba as mi

        (slope,) = opaque(1 / (np.sqrt(2) * self.projector.line_sigma))
        start, stop = (dr.opaque(mi.Int32, e) for e in (self.rows.start, self.rows.stop))
        lowest = mi.Int32(dr.ceil(v - reach))
        count = int(2 * reach) + 1

        def more(j: Any, below: Any) -> Any:
            return j < count

        def body(j: Any, below: Any) -> Any:
            row = lowest + j
            above = dr.erf((mi.Float(row) - v + 0.5) * slope)
            weight = 0.5 * (above - below)
            inside = seen & (row >= start) & (row < stop)
            put = (mi.UInt32(row - start) * self.slots + self.slot) * 3
            for channel in range(3):
                dr.scatter_add(self.film, value[channel] * weight, put + channel, inside)
            return j + 1, above

        below = dr.erf((mi.Float(lowest) - v - 0.5) * slope)
        dr.while_loop((mi.Int32(0), below), more, body, label="rows of a vertex")

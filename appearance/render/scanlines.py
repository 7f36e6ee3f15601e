"""Scanline sweeps: every row of every projector from one set of camera paths."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from appearance.render.bounces import bounce_limit
from appearance.render.coverage import covered_pixels
from appearance.render.paths import PointSource, Surface, light_from, pixel_indices
from appearance.render.tracing import (
    PathLimits,
    PathPlan,
    Paths,
    add_light,
    follow,
    render_again,
    tile_count,
)
from appearance.scene.hair_scene import SCALE, HairScene
from appearance.scene.opaque import opaque, opaque_index, opaque_matrix
from reconstruction import Camera, Projector
from reconstruction.arrays import Bools, Floats, Ints
from reconstruction.options import Count, options

_PILOT = 512  # pixels of the pilot pass
_PILOT_STREAM = 1 << 31
_REACH = 4.0  # standard deviations of the line's blur beyond which a row is skipped


@options
class ScanlineOptions:
    """Sampling of `render_scanlines`: `spp` paths a pixel for all rows; the rest as in
    `OlatOptions`."""

    spp: Count = 16
    max_depth: Count | None = None
    thrift: Annotated[float, Field(ge=0)] = 0.2
    memory: Count = 1 << 30


def render_scanlines(
    scene: HairScene,
    camera: Camera,
    projectors: Sequence[Projector],
    *,
    seed: int = 0,
    pixels: ArrayLike | None = None,
    rows: Mapping[str, range] | None = None,
    **options: Any,
) -> dict[str, Floats]:
    """Radiance of each row of each projector at full level, W/(sr m²).

    Returns by projector name `(rows, H, W, 3)`, or `(rows, P, 3)` for `pixels (P,)` (flat
    indices). A path vertex projects to one fractional row, and its light is distributed over the
    rows within the line's blur (`Projector.row_weight`), so one pass renders the sweep. The sum
    over rows is the projector with all rows on. `rows` limits a projector to a range. `options`:
    see `ScanlineOptions`. For a moved subject, give the camera and projectors `moved` inversely.
    Fibres scatter the mean of the BSDF over parts of their width (`mean_over_width`).
    """
    sweep = _sweep(projectors, rows)
    index = covered_pixels(scene, camera) if pixels is None else pixel_indices(camera, pixels)
    size = camera.height * camera.width if pixels is None else len(index)
    out = {p.name: np.zeros((len(r), size, 3), np.float32) for p, r in sweep}
    chosen = ScanlineOptions(**options)
    if len(index):
        plan = _plan(scene, camera, sweep, index, chosen, seed)
        tiles = tile_count(index, 3 * 12 * sum(len(r) for _, r in sweep), chosen.memory)
        places = index if pixels is None else np.arange(len(index))

        def render(part: Any, stream: int) -> None:
            for name, film in plan.render(index[part], chosen.spp, (seed, stream)).items():
                out[name][:, places[part]] = film

        def finite() -> Bools:
            every: Bools = np.ones(len(index), bool)
            for film in out.values():
                every &= np.asarray(np.isfinite(film).all(axis=(0, 2)))[places]
            return every

        for k in range(tiles):
            render(slice(k, None, tiles), k)
        render_again(camera, index, finite, lambda bad: render(bad, tiles), seed)
    if pixels is not None:
        return out
    return {n: o.reshape(len(o), camera.height, camera.width, 3) for n, o in out.items()}


Sweep = Sequence[tuple[Projector, range]]
"""Projectors and which of their rows."""


def _sweep(projectors: Sequence[Projector], rows: Mapping[str, range] | None) -> Sweep:
    if unknown := set(rows or {}) - {p.name for p in projectors}:
        names = [p.name for p in projectors]
        raise ValueError(f"rows names unknown projectors {sorted(unknown)}; there are {names}")
    return [(p, _rows(p, (rows or {}).get(p.name))) for p in projectors]


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
    """The input of a sweep, and its sampling; `dim` as in `PointSource`."""

    scene: HairScene
    camera: Camera
    sweep: Sweep
    limits: PathLimits
    dim: tuple[float, ...]

    def render(self, index: Ints, spp: int, seed: tuple[int, int]) -> dict[str, Floats]:
        """Mean over `spp` paths a pixel: `(rows, P, 3)` by projector."""
        n = len(index)
        surface, slots = Surface(self.scene, mean_width=True), opaque_index(n)
        gathers = [
            _Gather(surface, dr.zeros(mi.Float, 3 * len(rows) * n), slots, p, rows, dim)
            for (p, rows), dim in zip(self.sweep, self.dim, strict=True)
        ]

        def gather(si: Any, paths: Paths) -> None:
            for one in gathers:
                one(si, paths)

        follow(surface, self.camera, index, PathPlan(spp, seed, self.limits), gather)
        out = {}
        for one in gathers:
            film = np.array(one.film).reshape(len(one.rows), 3, n).transpose(0, 2, 1)
            out[one.projector.name] = np.asarray(film / np.float32(spp), np.float32)
        return out


def _plan(
    scene: HairScene,
    camera: Camera,
    sweep: Sweep,
    index: Ints,
    options: ScanlineOptions,
    seed: int,
) -> _Plan:
    depth = options.max_depth or bounce_limit(scene, camera, pixels=index, seed=seed).depth
    plan = _Plan(scene, camera, sweep, PathLimits(depth), (0.0,) * len(sweep))
    if options.thrift > 0:
        films = plan.render(index[:: -(-len(index) // _PILOT)], 1, (seed, _PILOT_STREAM))
        brought = [f.sum(0).max(-1) for f in films.values()]
        dim = (options.thrift * float(np.sqrt((b.astype(float) ** 2).mean())) for b in brought)
        plan = replace(plan, dim=tuple(dim))
    return plan


@dataclass(frozen=True)
class _Gather:
    """One projector's light at a path's vertex, split over its rows."""

    surface: Surface
    film: Any
    slots: Any
    projector: Projector
    rows: range
    dim: float

    def __call__(self, si: Any, paths: Paths) -> None:
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
        seen = paths.active & (local.z > 0) & (u >= -0.5) & (u < k[5]) & (v > low) & (v < high)
        intensity = mi.Color3f(*opaque(p.intensity * SCALE**2))
        (dim,) = opaque(self.dim)
        chance = paths.rng.next_float32()
        source = PointSource(centre, intensity, dim)
        towards = self.surface.towards(si, seen)

        def scattered(wo: Any, active: Any) -> Any:
            return paths.throughput * towards(wo, active)

        value, seen = light_from(self.surface.scene, si, scattered, source, chance, seen)
        self._splat(value, v, reach, paths.slot, seen)

    def _splat(self, value: Any, v: Any, reach: float, slot: Any, seen: Any) -> None:
        """Add `value` to the rows near `v`, weighted as `Projector.row_weight` does."""
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
            first = mi.UInt32(row - start) * 3 * self.slots + slot
            add_light(self.film, value * weight, first, inside, self.slots)
            return j + 1, above

        below = dr.erf((mi.Float(lowest) - v - 0.5) * slope)
        dr.while_loop((mi.Int32(0), below), more, body, label="rows of a vertex")

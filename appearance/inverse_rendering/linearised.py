"""The pictures of kept paths, and how they change with what all hair shares, exactly."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance.bsdf.lobes import Fibre, evaluate
from appearance.bsdf.maps import HairMaps, MappedStrands
from appearance.bsdf.shading_frame import ShadingFrame, axis_in_frame
from appearance.render.kept_paths import KeptPaths, Scattering
from reconstruction.array_backend import for_kernels, rows_of
from reconstruction.arrays import AnyFloats, Array, Floats, Ints

SCALARS = ("beta_m", "beta_n", "eta")
_DARK = 1e-25
"""BSDF below which a path counts as black: its logarithm's derivative is not asked for."""


@dataclass(frozen=True, eq=False)
class Cells:
    """Where V vertices lie in a volume of cells: between the cell `low (V,)`, a flat index, and the
    one `stride` further on, to which `share (V,)` belongs."""

    low: Ints
    share: Floats
    stride: int

    @classmethod
    def of(cls, paths: KeptPaths, mapped: MappedStrands, shape: tuple[int, int, int]) -> Cells:
        """As the BSDF looks its tables up: nearest on the scalp, linear along the strand."""
        layers, columns, rows = shape
        u, v = mapped.root_uv[paths.strand].T
        column = np.minimum((u * columns).astype(np.int64), columns - 1)
        row = np.minimum((v * rows).astype(np.int64), rows - 1)
        height = paths.along * (layers - 1)
        below = np.clip(height.astype(np.int64), 0, max(layers - 2, 0))
        low = (below * columns + column) * rows + row
        return cls(low, (height - below).astype(np.float32), columns * rows if layers > 1 else 0)

    def look_up(self, table: Array) -> Array:
        """`table (n_c, w, h, c)` at the vertices `(V, c)`."""
        flat, share = table.reshape(-1, table.shape[-1]), self.share[:, None]
        return np.asarray(flat[self.low] * (1 - share) + flat[self.low + self.stride] * share)


class LinearisedPictures:
    """Pictures `(2, L, P, 3)` of either half of the `paths`, with `maps` on the hair.

    `intensities (L, 3)` of the lights are in scene units, pictures in theirs.
    """

    def __init__(
        self, paths: KeptPaths, mapped: MappedStrands, maps: HairMaps, intensities: AnyFloats
    ) -> None:
        self._paths = paths
        self._cells = Cells.of(paths, mapped, maps.shape)
        onward, self._onward = self._scattered(maps, paths.onward)
        lit, self._lit = self._scattered(maps, paths.lit)
        factor = onward * paths.onward.scale[:, None]
        throughput = self._along(factor, np.multiply, 1.0)
        at = paths.lit.vertex
        slot, sample = paths.path[at] % paths.pixels, paths.path[at] // paths.pixels
        half = half_of(np.arange(paths.spp))
        scale = paths.lit.scale / np.bincount(half, minlength=2)[half[sample]]
        self._light = throughput[at] * lit * scale[:, None] * intensities[paths.light]
        self._index = (half[sample] * paths.lights + paths.light) * paths.pixels + slot
        self._first = (at < paths.starts[1])[:, None]

    def picture(self) -> Array:
        """The pictures."""
        return self._film(self._light)

    def change(self, moved: Mapping[str, Any], *, first_hit: bool = False) -> Array:
        """Their derivative along `moved`: changes of sigma_a `(n_c, w, h, 3)` and of scalars.

        On `first_hit`, of the light alone that the first vertex of a path gets and how it scatters
        it: hardly noisy.
        """
        lit = self._logarithms(moved, self._paths.lit, self._lit)
        if first_hit:
            return self._film(self._light * np.where(self._first, lit, 0))
        onward = self._logarithms(moved, self._paths.onward, self._onward)
        before = self._along(onward, np.add, 0.0)
        return self._film(self._light * (before[self._paths.lit.vertex] + lit))

    def _logarithms(
        self, moved: Mapping[str, Any], which: Scattering, logs: Mapping[str, Floats]
    ) -> Array:
        """Changes of the BSDF's logarithm `(N, 3)`."""
        total = np.zeros((len(which.vertex), 3))
        for name, by in moved.items():
            total += logs[name] * (by if name in SCALARS else self._cells.look_up(by)[which.vertex])
        return total

    def _along(self, values: AnyFloats, combine: Any, first: float) -> Array:
        """What the rows of `onward` make together up to each vertex `(V, 3)`."""
        starts = self._paths.starts
        out = np.full((starts[-1], 3), first)
        for begin, end in pairwise(starts[1:]):
            rows = slice(begin - starts[1], end - starts[1])
            out[begin:end] = combine(out[self._paths.onward.vertex[rows]], values[rows])
        return out

    def _film(self, values: Array) -> Array:
        size = 2 * self._paths.lights * self._paths.pixels
        sums = [np.bincount(self._index, values[:, k], size) for k in range(3)]
        film: Array = np.stack(sums, axis=-1, dtype=np.float64)
        return film.reshape(2, self._paths.lights, self._paths.pixels, 3)

    def _scattered(self, maps: HairMaps, which: Scattering) -> tuple[Floats, dict[str, Floats]]:
        """BSDF times cosine `(N, 3)`, and its logarithm's derivatives `(N, 3)` by name.

        Those by sigma_a are by each channel's own. Skin keeps its value.
        """
        at, names = which.vertex, ("sigma_a", *SCALARS)
        if not len(at):
            return which.value, dict.fromkeys(names, which.value)
        sigma_a = mi.Color3f(*_floats(self._cells.look_up(maps.sigma_a)[at]))
        scalars = {n: dr.opaque(mi.Float, float(getattr(maps, n))) for n in SCALARS}
        tilt = dr.opaque(mi.Float, float(np.radians(maps.tilt_deg)))
        turn = None
        if maps.rotation.any():
            a, b = _floats(self._cells.look_up(maps.rotation)[at])
            turn = mi.Vector3f(*axis_in_frame(a, b, *_floats(self._paths.normal[at])))
        frame = ShadingFrame(None, turn)
        wi = frame.enter(mi.Vector3f(*_floats(self._paths.incoming[at])))
        wo = frame.enter(mi.Vector3f(*_floats(which.direction)))
        value = mi.Color3f(evaluate(Fibre(sigma_a, **scalars, tilt=tilt), wi, wo)[0])
        changes = {}
        for name in names:
            known: dict[str, Any] = {"sigma_a": sigma_a, **scalars}
            kind: Any = type(known[name])
            known[name] = kind(known[name])
            dr.enable_grad(known[name])
            dr.set_grad(known[name], 1)
            moved = mi.Color3f(evaluate(Fibre(**known, tilt=tilt), wi, wo)[0])
            changes[name] = dr.forward_to(moved)
        dr.eval(value, changes)
        hair = self._paths.hair[at][:, None]
        values = np.where(hair, rows_of(value), which.value)
        bright = hair & (values > _DARK)
        whole = np.where(bright, values, 1)
        return values, {
            name: np.where(bright, rows_of(change) / whole, 0) for name, change in changes.items()
        }


def half_of(samples: Ints) -> Ints:
    """Which half each of a pixel's samples belongs to: a chessboard on the grid over the pixel."""
    side = int(len(samples) ** 0.5)
    return (samples + (samples // side if side % 2 == 0 else 0)) & 1


def _floats(values: AnyFloats) -> list[Any]:
    """The columns of `values (N, c)` as Dr.Jit arrays."""
    return [mi.Float(for_kernels(column)) for column in values.T]

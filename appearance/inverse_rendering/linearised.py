"""Images of cached paths, and their exact derivatives by the hair's parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance.bsdf.lobes import Fibre, evaluate
from appearance.bsdf.maps import HairMaps, MappedStrands
from appearance.bsdf.shading_frame import ShadingFrame, axis_in_frame
from appearance.render.cached_paths import CachedPaths, Scattering
from reconstruction.array_backend import for_kernels, rows_of
from reconstruction.arrays import AnyFloats, Array, Floats, Ints
from reconstruction.geometry.lights import mixed

SCALARS = ("beta_m", "beta_n", "eta")
SHARED = ("sigma_a", *SCALARS)
_DARK = 1e-25
"""BSDF below which a path counts as black and its logarithm has no derivative."""


@dataclass(frozen=True, eq=False)
class Cells:
    """Where V vertices lie in a volume of cells: between the cell `low (V,)`, a flat index, and the
    one `stride` further on, to which `share (V,)` belongs."""

    low: Ints
    share: Floats
    stride: int

    @classmethod
    def of(cls, paths: CachedPaths, mapped: MappedStrands, shape: tuple[int, int, int]) -> Cells:
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

    def gathered(self, values: Array, vertex: Ints, size: int) -> Array:
        """The transpose of `look_up`: sums `(size, c)` over cells of `values (N, c)` at vertices
        `(N,)`."""
        low, share = self.low[vertex], self.share[vertex, None]
        parts = ((low, values * (1 - share)), (low + self.stride, values * share))
        return np.asarray(
            sum(
                np.stack([np.bincount(cell, x, size) for x in part.T], axis=-1)
                for cell, part in parts
            )
        )


class LinearisedPictures:
    """Images `(2, L, P, 3)` of either half of the `paths`, with `maps` on the hair; of patterns,
    one for each.

    `intensities (L, 3)` of the single lights are in scene units, images in theirs. Derivatives are
    those by `names`, of `SHARED` and "rotation".
    """

    def __init__(
        self,
        paths: CachedPaths,
        mapped: MappedStrands,
        maps: HairMaps,
        intensities: AnyFloats,
        names: Sequence[str] = SHARED,
    ) -> None:
        self._paths, self._names = paths, tuple(names)
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
        """The images `(2, L, P, 3)`, of each half of the samples."""
        return self._film(self._light)

    def change(self, moved: Mapping[str, Any], *, first_hit: bool = False) -> Array:
        """Their derivative along `moved`: changes of sigma_a `(n_c, w, h, 3)`, of rotation
        `(n_c, w, h, 2)` and of scalars.

        With `first_hit`, only of the first vertex's direct light, with little noise.
        """
        lit = self._logarithms(moved, self._paths.lit, self._lit)
        if first_hit:
            return self._film(self._light * np.where(self._first, lit, 0))
        onward = self._logarithms(moved, self._paths.onward, self._onward)
        before = self._along(onward, np.add, 0.0)
        return self._film(self._light * (before[self._paths.lit.vertex] + lit))

    def rotation_gradient(self, weight: Array, shape: tuple[int, int, int]) -> Array:
        """By the correctives `(n_c, w, h, 2)` of `shape`: the derivative of the sum of `weight (2,
        L, P, 3)` times the pictures, of the first hit's light."""
        mix = self._paths.mix
        weight = weight if mix is None else mixed(mix.T, weight, axis=1)
        light = self._light * np.where(self._first, weight.reshape(-1, 3)[self._index], 0)
        values = (light[..., None] * self._lit["rotation"]).sum(axis=1)
        found = self._cells.gathered(values, self._paths.lit.vertex, int(np.prod(shape)))
        return found.reshape(*shape, 2)

    def _logarithms(
        self, moved: Mapping[str, Any], which: Scattering, logs: Mapping[str, Floats]
    ) -> Array:
        """Changes of the BSDF's logarithm `(N, 3)`."""
        total = np.zeros((len(which.vertex), 3))
        for name, by in moved.items():
            if name in SCALARS:
                total += logs[name] * by
                continue
            here = self._cells.look_up(by)[which.vertex]
            if name == "rotation":
                total += (logs[name] * here[:, None]).sum(axis=-1)
            else:
                total += logs[name] * here
        return total

    def _along(self, values: AnyFloats, combine: Any, first: float) -> Array:
        """Sums over the rows of `onward` up to each vertex `(V, 3)`."""
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
        film = film.reshape(2, self._paths.lights, self._paths.pixels, 3)
        return np.asarray(mixed(self._paths.mix, film, axis=1))

    def _scattered(self, maps: HairMaps, which: Scattering) -> tuple[Floats, dict[str, Floats]]:
        """BSDF times cosine `(N, 3)`, and its logarithm's derivatives by name.

        `(N, 3)`, those by sigma_a by each channel's own; `(N, 3, 2)` by rotation. Skin keeps its
        value.
        """
        at = which.vertex
        if not len(at):
            nothing: dict[str, Floats] = dict.fromkeys(SHARED, which.value)
            return which.value, nothing | {"rotation": np.zeros((0, 3, 2), np.float32)}
        known: dict[str, Any] = {
            "sigma_a": mi.Color3f(*_floats(self._cells.look_up(maps.sigma_a)[at])),
            **{n: dr.opaque(mi.Float, float(getattr(maps, n))) for n in SCALARS},
        }
        turn: list[Any] | None = None
        if maps.rotation.any() or "rotation" in self._names:
            turn = _floats(self._cells.look_up(maps.rotation)[at])
        wi = mi.Vector3f(*_floats(self._paths.incoming[at]))
        wo = mi.Vector3f(*_floats(which.direction))
        normal, tilt = _floats(self._paths.normal[at]), float(np.radians(maps.tilt_deg))
        opaque_tilt = dr.opaque(mi.Float, tilt)

        def scattered(hair: Mapping[str, Any], turn: Sequence[Any] | None) -> Any:
            axis = None if turn is None else mi.Vector3f(*axis_in_frame(*turn, *normal))
            frame = ShadingFrame(None, axis)
            fibre = Fibre(**hair, tilt=opaque_tilt)
            return mi.Color3f(evaluate(fibre, frame.enter(wi), frame.enter(wo))[0])

        value = scattered(known, turn)
        changes: dict[str, list[Any]] = {}
        for name in self._names:
            if name == "rotation" and turn is not None:
                free = [[_moving(x) if i == k else x for i, x in enumerate(turn)] for k in (0, 1)]
                changes[name] = [dr.forward_to(scattered(known, x)) for x in free]
            else:
                moved = scattered({**known, name: _moving(known[name])}, turn)
                changes[name] = [dr.forward_to(moved)]
        dr.eval(value, changes)
        hair = self._paths.hair[at][:, None]
        values = np.where(hair, rows_of(value), which.value)
        bright = hair & (values > _DARK)
        whole = np.where(bright, values, 1)
        logs = {}
        for name, change in changes.items():
            each = [np.where(bright, rows_of(x) / whole, 0) for x in change]
            logs[name] = np.stack(each, axis=-1) if name == "rotation" else each[0]
        return values, logs


def _moving(value: Any) -> Any:
    """A copy of a Dr.Jit `value` with forward-mode gradients enabled."""
    kind: Any = type(value)
    out = kind(value)
    dr.enable_grad(out)
    dr.set_grad(out, 1)
    return out


def half_of(samples: Ints) -> Ints:
    """The half `(n,)`, 0 or 1, of a pixel's `samples (n,)`: a chessboard on the grid over it."""
    side = int(len(samples) ** 0.5)
    return (samples + (samples // side if side % 2 == 0 else 0)) & 1


def _floats(values: AnyFloats) -> list[Any]:
    """The columns of `values (N, c)` as Dr.Jit arrays."""
    return [mi.Float(for_kernels(column)) for column in values.T]

"""A fitted field: its values at anchors, and their evaluation at pixels."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace
from typing import get_args

import numpy as np

from appearance.bsdf.maps import MappedStrands
from appearance.fields.anchors import Grid, Places
from appearance.fields.form import Form
from appearance.fields.hits import HitOptions, Hits, find_hits
from appearance.fields.options import Kind
from appearance.render.harmonics import count_of
from appearance.render.pixel_field import PixelField
from appearance.scene.hair_scene import HairScene
from reconstruction import Camera, Model, ModelError
from reconstruction.arrays import Array, Floats, Ints

FIELD_FILE = "field.npz"
HITS = HitOptions(8, seed=77)
"""For images; a field varies little within a pixel."""
_AT_ONCE = 1 << 14
"""Pixels per block."""


@dataclass(frozen=True, eq=False)
class Field:
    """Harmonics at the anchors of a grid, looked up by `places`.

    `values (M, v · n · 3)` of the anchors `rows (M,)`, 0 at all others; v harmonics of the
    direction to the camera, n = v of that to the light, up to `degree`.
    """

    kind: Kind
    degree: int
    grid: Grid
    places: Places
    rows: Ints
    values: Floats

    @classmethod
    def of(cls, form: Form, grid: Grid, places: Places, coefficients: Floats) -> Field:
        """The field of `coefficients` at all anchors `(grid.count, Q · 3)`."""
        rows = np.flatnonzero(coefficients.any(axis=1))
        values = coefficients[rows]
        return cls(form.kind, form.degree, grid, places, rows, values)

    @property
    def form(self) -> Form:
        """Kind and degree."""
        return Form(self.kind, self.degree)

    def on_cut(self, share: Array) -> Field:
        """The field on strands cut to `share (S,)` of their length."""
        return replace(self, places=replace(self.places, kept=self.places.kept * share))

    def on_others(self, nearest: Ints) -> Field:
        """The field on other strands, by the number of the corresponding one, `nearest (S',)`."""
        p = self.places
        others = Places(p.root_uv[nearest], p.kept[nearest], p.fitted[nearest])
        return replace(self, places=others)

    def coefficients(self) -> Floats:
        """The values of all anchors `(grid.count, v · n · 3)`."""
        out = np.zeros((self.grid.count, self.values.shape[1]), np.float32)
        out[self.rows] = self.values
        return out

    def at(self, hits: Hits) -> PixelField:
        """The field at the pixels of `hits`."""
        full, parts = self.coefficients(), []
        for start in range(0, len(hits.pixels), _AT_ONCE):
            part = slice(start, start + _AT_ONCE)
            few = replace(hits, pixels=hits.pixels[part], table=hits.table[part])
            parts.append(self.form.basis(few, self.grid, self.places).at_pixels(full))
        found = np.concatenate(parts) if parts else np.zeros((0, count_of(self.degree), 3))
        additive = self.kind != "modulation"
        return PixelField(
            found.astype(np.float32), hits.middle(), additive, alone=self.kind == "whole"
        )

    def save(self, model: Model) -> None:
        """Write `field.npz`."""
        grid = self.grid
        shape = [grid.layers, grid.columns, grid.rows, grid.strands]
        model.write_arrays(
            FIELD_FILE,
            {
                "kind": np.array(self.kind),
                "degree": np.array(self.degree),
                "grid": np.array(shape, np.int64),
                "root_uv": self.places.root_uv.astype(np.float32),
                "kept": self.places.kept.astype(np.float32),
                "fitted": self.places.fitted.astype(np.int64),
                "rows": self.rows.astype(np.int64),
                "values": self.values.astype(np.float32),
            },
        )

    @classmethod
    def load(cls, model: Model) -> Field:
        """Read `field.npz`. Raises `ModelError` if it is missing or not a field."""
        data = model.arrays(FIELD_FILE)
        try:
            kinds: dict[str, Kind] = {name: name for name in get_args(Kind)}
            kind, degree = kinds.get(str(data["kind"])), int(data["degree"])
            grid = Grid(*(int(n) for n in data["grid"]))
            rows, values = data["rows"].astype(np.int64), data["values"].astype(np.float32)
            form = Form(kind or "modulation", degree)
            if kind is None or values.shape != (len(rows), form.count * 3):
                raise ValueError(f"kind {data['kind']}, degree {degree}, values {values.shape}")
            if len(rows) and (rows.min() < 0 or rows.max() >= grid.count):
                raise ValueError(f"anchors {rows.min()} to {rows.max()} of {grid.count}")
            if not np.isfinite(values).all():
                raise ValueError("values that are not finite")
            uv, kept = (data[k].astype(np.float64) for k in ("root_uv", "kept"))
            places = Places(uv, kept, data["fitted"].astype(np.int64))
        except (KeyError, TypeError, ValueError) as error:
            path = model.file(FIELD_FILE)
            raise ModelError(
                f"{path}: {error}: run 'hairstage fit --stages field' again"
            ) from error
        return cls(kind, degree, grid, places, rows, values)


@dataclass(frozen=True, eq=False)
class FieldOnStrands:
    """A field on `mapped` strands: the `SceneField` of their scene, in any pose."""

    of: Field
    mapped: MappedStrands
    _last: dict[str, PixelField] = field(default_factory=dict)

    def at_pixels(self, scene: HairScene, camera: Camera, pixels: Ints) -> PixelField:
        """The field at the flat `pixels (P,)` of `camera`, under `HITS` rays a pixel."""
        key = hashlib.sha256(repr(camera.to_dict()).encode() + pixels.tobytes()).hexdigest()
        if key not in self._last:
            self._last.clear()
            hits = find_hits(replace(self.mapped, scene=scene), camera, pixels, HITS)
            self._last[key] = self.of.at(hits)
        return self._last[key]

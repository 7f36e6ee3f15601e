"""Kind and degree of a field's coefficients."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from appearance.fields.anchors import Grid, Places
from appearance.fields.basis import ViewBasis
from appearance.fields.hits import Hits
from appearance.fields.options import Kind
from appearance.render.harmonics import count_of, degrees
from reconstruction.arrays import Array


@dataclass(frozen=True)
class Form:
    """A `kind` of field, of harmonics up to `degree`."""

    kind: Kind
    degree: int

    @property
    def count(self) -> int:
        """Q coefficients of an anchor and channel."""
        return count_of(self.degree) ** 2

    @property
    def growth(self) -> Array:
        """Factor on the ridge `(Q,)`: (1 + a(a + 1))(1 + b(b + 1)) of degrees a, b."""
        grows = 1 + degrees(self.degree) * (degrees(self.degree) + 1.0)
        return np.asarray(np.outer(grows, grows).ravel())

    def basis(self, hits: Hits, grid: Grid, places: Places) -> ViewBasis:
        """Its map to the pixels of `hits`, with anchors of `grid`."""
        in_strands = self.kind == "modulation"
        return ViewBasis.of(hits, grid, places, self.degree, in_strands=in_strands)

"""What the coefficients of a field are of, and how they come to pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from appearance.fields.anchors import Grid, Places
from appearance.fields.basis import TurningBasis, ViewBasis
from appearance.fields.hits import Hits
from appearance.fields.options import FieldOptions, Kind
from appearance.fields.turns import COUNT, DEGREE
from appearance.render.harmonics import count_of, degrees
from reconstruction.arrays import Array, Ints

Basis = ViewBasis | TurningBasis


@dataclass(frozen=True)
class Form:
    """A `kind` of field: of harmonics up to `degree`, or of turns of lobes of a roughness.

    `stiffness` is how much stronger the ridge of a factor is than that of turns.
    """

    kind: Kind
    degree: int
    beta_m: float = 0.0
    stiffness: float = 1.0

    @classmethod
    def of(cls, options: FieldOptions) -> Form:
        """That of the options."""
        if options.kind == "turns":
            return cls("turns", DEGREE, options.beta_m)
        return cls(options.kind, options.degree)

    @property
    def count(self) -> int:
        """Q coefficients of an anchor and channel."""
        return COUNT if self.kind == "turns" else count_of(self.degree) ** 2

    @property
    def growth(self) -> Array:
        """What the ridge of each grows by `(Q,)`: (1 + a(a + 1))(1 + b(b + 1)) of degrees a, b."""
        if self.kind == "turns":
            return np.array([self.stiffness, 1.0, 1.0])
        grows = 1 + degrees(self.degree) * (degrees(self.degree) + 1.0)
        return np.asarray(np.outer(grows, grows).ravel())

    @property
    def alike(self) -> Ints:
        """Of what a pixel has, which share their mean in a preconditioner: equal numbers `(n,)`."""
        return np.arange(COUNT) if self.kind == "turns" else degrees(self.degree)

    def basis(self, hits: Hits, grid: Grid, places: Places) -> Basis:
        """What the pixels of `hits` show of it, with anchors of `grid`."""
        if self.kind == "turns":
            return TurningBasis.of(hits, grid, places, self.beta_m)
        in_strands = self.kind == "modulation"
        return ViewBasis.of(hits, grid, places, self.degree, in_strands=in_strands)

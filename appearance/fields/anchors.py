"""Anchors of a field's values, along strands in cells of the scalp or on every strand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import csr_matrix, hstack, identity

from appearance.fields.hits import Hits
from reconstruction.arrays import Array, Floats, Ints


@dataclass(frozen=True, eq=False)
class Places:
    """The strands' coordinates for the lookup of anchors.

    `root_uv (S, 2)` in [0, 1] on the scalp's map; `kept (S,)` the remaining share of the fitted
    strand's length after cuts; `fitted (S,)` the number of the corresponding fitted strand.
    """

    root_uv: Array
    kept: Array
    fitted: Ints

    @classmethod
    def of(cls, root_uv: Array) -> Places:
        """Those of the fitted strands, their roots at `root_uv (S, 2)`."""
        return cls(root_uv, np.ones(len(root_uv)), np.arange(len(root_uv)))


@dataclass(frozen=True)
class Grid:
    """`layers` anchors along every strand, of `columns` x `rows` cells, or of `strands` each."""

    layers: int
    columns: int
    rows: int
    strands: int

    @classmethod
    def of(cls, level: Sequence[int], strands: int) -> Grid:
        """The grid of a level (n_c, w, h) of the options."""
        layers, columns, rows = level
        if (columns == 0) != (rows == 0):
            raise ValueError(f"a level is (n_c, w, h) or (n_c, 0, 0), got {tuple(level)}")
        return cls(layers, columns, rows, strands)

    @property
    def across(self) -> int:
        """Anchors of a layer."""
        return self.columns * self.rows or self.strands

    @property
    def count(self) -> int:
        """All anchors."""
        return self.layers * self.across

    def near(self, strand: Ints, along: Array, places: Places) -> tuple[Ints, Ints, Floats]:
        """Two anchors `(H,)` around each point, by `strand (H,)` and `along (H,)`, 0 root to 1 tip,
        and the weight of the second."""
        if self.columns:
            u, v = places.root_uv[strand].T
            column = np.minimum((u * self.columns).astype(np.int64), self.columns - 1)
            cell = column * self.rows + np.minimum((v * self.rows).astype(np.int64), self.rows - 1)
        else:
            cell = places.fitted[strand]
        height = np.clip(along * places.kept[strand], 0, 1) * (self.layers - 1)
        low = np.minimum(height.astype(np.int64), max(self.layers - 2, 0))
        high = np.minimum(low + 1, self.layers - 1)
        share = (height - low).astype(np.float32)
        return low * self.across + cell, high * self.across + cell, share


def nested(grids: Sequence[Grid], places: Places) -> Any:
    """Sparse matrix `(anchors of the last grid, anchors of all)` that sums all grids' values."""
    finest = grids[-1]
    parts = [_refined(grid, finest, places) for grid in grids[:-1]]
    return csr_matrix(hstack([*parts, identity(finest.count, np.float32)], format="csr"))


def _refined(grid: Grid, finest: Grid, places: Places) -> Any:
    anchor = np.arange(finest.count)
    layer, cell = np.divmod(anchor, finest.across)
    along = layer / max(finest.layers - 1, 1)
    if finest.columns:
        uv = np.stack(np.divmod(cell, finest.rows), -1) + 0.5
        at = Places.of(uv / (finest.columns, finest.rows))
    else:
        at = places
    low, high, share = grid.near(cell, along, at)
    rows = np.concatenate([anchor, anchor])
    values = np.concatenate([1 - share, share])
    both = (values, (rows, np.concatenate([low, high])))
    return csr_matrix(both, shape=(finest.count, grid.count), dtype=np.float32)


def anchors_of(hits: Hits, grid: Grid, places: Places) -> tuple[Ints, Ints, Ints, Floats]:
    """Numbers of the hits on hair `(H,)`, and the result of `near` for them."""
    strand = hits.column("strand").ravel()
    number = np.flatnonzero(strand >= 0)
    along = hits.column("along").ravel()[number]
    return (number, *grid.near(strand[number].astype(np.int64), along, places))

"""Linear map from a field's coefficients at anchors to harmonics at pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import csc_matrix, csr_matrix

from appearance.fields.anchors import Grid, Places, anchors_of
from appearance.fields.hits import Hits
from appearance.render.harmonics import harmonics, turns
from reconstruction.arrays import Floats, Ints


@dataclass(frozen=True, eq=False)
class ViewBasis:
    """The map of a field's coefficients to P pixels of one camera.

    Coefficients `(M, v · n · c)` of M anchors, v harmonics of the direction to the camera, n of
    that to the light, and c columns (three channels per field); the result `(P, n, c)` are
    harmonics of the direction to the light in the world. `views (H, M v)` has the weighted
    harmonics of each hit on hair, `turned (P n, H n)` rotates from the strands' frames to the world
    and sums hits, `pixel (H,)` is each hit's; both are None for fields in the world's frame, where
    `views` is `(P, M v)`.
    """

    views: Any
    turned: Any
    pixel: Ints | None
    harmonics: int

    @classmethod
    def of(
        cls, hits: Hits, grid: Grid, places: Places, degree: int, *, in_strands: bool
    ) -> ViewBasis:
        """The map of `hits` for anchors of `grid`, if `in_strands` in the strands' frames."""
        number, low, high, share = anchors_of(hits, grid, places)
        away = hits.towards_camera().reshape(-1, 3)[number]
        of_pixel, turned = number // hits.count, None
        if in_strands:
            frames = strand_frames(hits, number)
            away = np.einsum("hi,hij->hj", away, frames)
            turned = _turning(turns(frames, degree), of_pixel, len(hits.pixels))
        weight = hits.column("weight").ravel()[number]
        y = harmonics(away, degree) * weight[:, None]
        v, count = y.shape[1], len(number)
        values = np.stack([y * (1 - share)[:, None], y * share[:, None]], axis=1)
        first = np.stack([low, high], axis=1) * v
        index = first[:, :, None] + np.arange(v)
        bounds = np.arange(count + 1) * 2 * v
        views: Any = csr_matrix(
            (values.ravel().astype(np.float32), index.ravel().astype(np.int32), bounds),
            shape=(count, grid.count * v),
        )
        if turned is not None:
            return cls(views, turned, of_pixel, v)
        pixels: Any = csr_matrix(
            (np.ones(count, np.float32), (of_pixel, np.arange(count))),
            shape=(len(hits.pixels), count),
        )
        return cls((pixels @ views).tocsr(), None, None, v)

    def at_pixels(self, coefficients: Floats) -> Floats:
        """`coefficients (M, v · n · c)` as harmonics in the world `(P, n, c)`."""
        n = self.harmonics
        columns = coefficients.shape[1] // n**2
        found = self.views @ coefficients.reshape(self.views.shape[1], n * columns)
        if self.turned is not None:
            found = self.turned @ found.reshape(len(found) * n, columns)
        return np.asarray(found.reshape(-1, n, columns))

    def at_anchors(self, values: Floats) -> Floats:
        """The transpose: `values (P, n, c)` gathered at the anchors `(M, v · n · c)`."""
        n, columns = self.harmonics, values.shape[2]
        flat = values.reshape(len(values) * n, columns)
        if self.turned is not None:
            flat = self.turned.T @ flat
        gathered = self.views.T @ flat.reshape(self.views.shape[0], n * columns)
        return np.asarray(gathered.reshape(-1, n * n * columns))

    def squares(self, values: Floats) -> Floats:
        """Approximate diagonal `(M, v · n · c)` at the anchors of the diagonal `values (P, n, c)`
        at the pixels, which must be equal within each degree."""
        squared = self.views.copy()
        squared.data = squared.data**2
        n, columns = self.harmonics, values.shape[2]
        flat = values.reshape(len(values), n * columns)
        if self.pixel is not None:
            flat = flat[self.pixel]
            # hits of one pixel mostly share an anchor: K of weight 1/K are one of weight 1
            squared.data *= np.float32(len(flat) / max(len(values), 1))
        return np.asarray((squared.T @ flat).reshape(-1, n * n * columns))


def _turning(blocks: Sequence[Floats], pixel: Ints, pixels: int) -> Any:
    """The transposed blocks of `turns` of all hits as a sparse matrix `(pixels n, H n)`."""
    count, n = len(pixel), sum(b.shape[1] for b in blocks) + 1
    parts = [np.ones((count, 1, 1), np.float32), *blocks]
    index, values = [], []
    for k, block in enumerate(parts):
        within = np.arange(k * k, (k + 1) ** 2, dtype=np.int32)
        # CSC: a column is a harmonic of a hit's frame, its rows those of the world
        rows = pixel.astype(np.int32)[:, None, None] * n + within
        index.append(np.broadcast_to(rows, block.shape).reshape(count, within.size**2))
        values.append(block.reshape(count, within.size**2))
    each = np.repeat([2 * k + 1 for k in range(len(parts))], [2 * k + 1 for k in range(len(parts))])
    bounds = np.concatenate([[0], np.cumsum(np.tile(each, count))])
    flat = np.concatenate(values, axis=1).ravel(), np.concatenate(index, axis=1).ravel(), bounds
    return csc_matrix(flat, shape=(pixels * n, count * n))


def strand_frames(hits: Hits, number: Ints) -> Floats:
    """The strands' frames `(H, 3, 3)` at hits by their flat numbers: binormal, normal, tangent."""
    tangent, normal = (hits.column(n).reshape(-1, 3)[number] for n in ("tangent", "normal"))
    return np.stack([np.cross(tangent, normal), normal, tangent], axis=-1)

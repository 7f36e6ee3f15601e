"""From a field's coefficients at anchors to harmonics at pixels, and back."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import csr_matrix

from appearance.fields.anchors import Grid, Places, anchors_of
from appearance.fields.hits import Hits
from appearance.render.harmonics import count_of, harmonics, turns
from reconstruction.arrays import Floats, Ints


@dataclass(frozen=True, eq=False)
class ViewBasis:
    """What P pixels of one camera show of a field: a linear map of its coefficients.

    Coefficients `(M, v · n · 3)` belong to M anchors, v harmonics of the direction to the camera
    and n of that to the light, three channels; the result `(P, n, 3)` are harmonics of the
    direction to the light in the world. `views (H, M v)` has the weighted harmonics of each hit on
    hair, `pixels (P, H)` adds hits up, `turned` has the blocks that turn harmonics of the world
    into those of the strand's frame; None where the field's frame is the world.
    """

    views: Any
    pixels: Any
    turned: list[Floats] | None
    harmonics: int

    @classmethod
    def of(
        cls, hits: Hits, grid: Grid, places: Places, degree: int, *, in_strands: bool
    ) -> ViewBasis:
        """The map of the `hits` for anchors of `grid`; `in_strands`: in the strands' frames."""
        number, low, high, share = anchors_of(hits, grid, places)
        away = hits.towards_camera().reshape(-1, 3)[number]
        turned = None
        if in_strands:
            frames = strand_frames(hits, number)
            away = np.einsum("hi,hij->hj", away, frames)
            turned = turns(frames, degree)
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
        of_pixel = number // hits.count
        pixels: Any = csr_matrix(
            (np.ones(count, np.float32), (of_pixel, np.arange(count))),
            shape=(len(hits.pixels), count),
        )
        if turned is None:
            views, pixels = (pixels @ views).tocsr(), None
        return cls(views, pixels, turned, count_of(degree))

    def at_pixels(self, coefficients: Floats) -> Floats:
        """`coefficients (M, v · n · 3)` as harmonics in the world `(P, n, 3)`."""
        found = self.views @ coefficients.reshape(self.views.shape[1], -1)
        if self.turned is None:
            return np.asarray(found.reshape(-1, self.harmonics, 3))
        local = found.reshape(-1, self.harmonics, 3)
        for k, block in enumerate(self.turned, 1):
            part = slice(k * k, (k + 1) ** 2)
            local[:, part] = np.matmul(block.transpose(0, 2, 1), local[:, part])
        return np.asarray((self.pixels @ found).reshape(-1, self.harmonics, 3))

    def at_anchors(self, values: Floats) -> Floats:
        """The transpose: `values (P, n, 3)` gathered at the anchors `(M, v · n · 3)`."""
        flat = values.reshape(len(values), -1)
        if self.turned is not None:
            flat = self.pixels.T @ flat
            local = flat.reshape(-1, self.harmonics, 3)
            for k, block in enumerate(self.turned, 1):
                part = slice(k * k, (k + 1) ** 2)
                local[:, part] = np.matmul(block, local[:, part])
        gathered = self.views.T @ flat
        v = self.harmonics  # as many of the view as of the light
        return np.asarray(gathered.reshape(-1, v * self.harmonics * 3))

    def squares(self, values: Floats) -> Floats:
        """About the diagonal that `values (P, n, 3)`, a diagonal at the pixels, has at the anchors.

        `(M, v · n · 3)`; `values` must be the same within each degree.
        """
        flat = values.reshape(len(values), -1)
        if self.turned is not None:
            flat = self.pixels.T @ flat
        squared = self.views.copy()
        squared.data = np.abs(squared.data) ** 2
        if self.turned is not None:
            # hits of one pixel mostly share an anchor: K of weight 1/K count as one of weight 1
            squared.data *= np.float32(self.pixels.shape[1] / max(self.pixels.shape[0], 1))
        return np.asarray((squared.T @ flat).reshape(-1, self.harmonics * self.harmonics * 3))


def strand_frames(hits: Hits, number: Ints) -> Floats:
    """The strands' frames `(H, 3, 3)` at hits by their flat numbers: binormal, normal, tangent."""
    tangent, normal = (hits.column(n).reshape(-1, 3)[number] for n in ("tangent", "normal"))
    return np.stack([np.cross(tangent, normal), normal, tangent], axis=-1)

"""Input of all exports: strands with values per point and strand, head, material."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.cluster.vq import kmeans2
from scipy.spatial import cKDTree

from appearance.bsdf.longitudinal import colour_of_absorption
from appearance.bsdf.maps import HairMaps
from appearance.export.options import ExportOptions
from appearance.export.resizing import resized
from appearance.model.fitted_model import FittedModel
from reconstruction import Capture, Mesh, Model, Strands
from reconstruction.arrays import AnyFloats, Array, Floats, Ints
from reconstruction.geometry.world_frame import WorldFrame

MEASURED = 2e-3
"""Metres from a triangulated point at which the confidence of a strand's point is exp(-1/2)."""
SAME = 1e-6
"""Metres within which a vertex of the head is one of the scalp map's."""
SHAPE = 8
"""Points at equal arc lengths by which the shapes of strands are compared."""


@dataclass(frozen=True, eq=False)
class Groom:
    """Exported strands.

    `root_uv (S, 2)` are the roots on the scalp's map; `ids (S,)` the strands' indices in
    `strands.npz`. `confidence (N,)` in [0, 1] is the strands' own, else a Gaussian (`MEASURED`) of
    the distance to a triangulated point, None without both. `guides (G,)` are guide strands, `clump
    (S,)` each strand's guide; both empty without guides. `head_uv (V, 2)` is the map at the head's
    vertices, NaN off the scalp, or None.
    """

    strands: Strands
    head: Mesh | None
    skin: tuple[float, float, float]
    maps: HairMaps
    root_uv: Array
    ids: Ints
    confidence: Floats | None
    guides: Ints
    clump: Ints
    head_uv: Array | None = None

    @classmethod
    def load(
        cls,
        model: Model,
        capture: Capture | None = None,
        options: ExportOptions | None = None,
        moved: tuple[Strands, Ints] | None = None,
    ) -> Groom:
        """The groom of a model; `capture` gives the head if the model has none.

        `moved` are strands that replace the model's, and the index of the one that each is of. A
        model without a fit is brown (`FittedModel.unfitted`). Raises `ModelError` naming what is
        missing.
        """
        made = FittedModel.load if model.has("appearance.json") else FittedModel.unfitted
        fitted = made(model, capture)
        measured = model.points().points if model.has("points.npz") else None
        if moved is not None:
            fitted = replace(fitted, strands=moved[0], placed=fitted.root_uv[moved[1]])
        groom = cls.of(fitted, options or ExportOptions(), measured)
        if moved is not None:
            groom = replace(groom, ids=moved[1][groom.ids])
        if fitted.head is None or not model.has("scalp_map.npz"):
            return groom
        known = model.arrays("scalp_map.npz")
        distance, nearest = cKDTree(known["vertices"]).query(fitted.head.vertices)
        uv = np.where(distance[:, None] < SAME, known["uv"][nearest], np.nan)
        return replace(groom, head_uv=uv)

    @classmethod
    def of(
        cls, fitted: FittedModel, options: ExportOptions, measured: AnyFloats | None = None
    ) -> Groom:
        """The groom of a fit; `measured (M, 3)` are triangulated points."""
        strands, ids = resized(fitted.strands, options.strands, options.seed)
        confidence = strands.confidence
        if confidence is None and measured is not None and len(measured):
            far = 5 * MEASURED
            distance, _ = cKDTree(measured).query(strands.points, distance_upper_bound=far)
            confidence = np.exp(-0.5 * (distance / MEASURED) ** 2).astype(np.float32)
        guides, clump = clumps(strands, options.guides, options.seed)
        uv = fitted.root_uv[ids] if len(ids) else np.zeros((0, 2))  # nothing has no middle
        skin = fitted.appearance.skin
        maps, head = fitted.maps, fitted.head
        return cls(strands, head, skin, maps, uv, ids, confidence, guides, clump)

    def at(self, world: WorldFrame) -> Groom:
        """The groom in the frame and unit of `world`."""
        head = None if self.head is None else world.results(self.head)
        return replace(self, strands=world.results(self.strands), head=head)

    @cached_property
    def along(self) -> Floats:
        """Place of each point on its strand `(N,)`, 0 the root and 1 the tip, by its index."""
        strand, offsets = self.strands.strand_of_point, self.strands.offsets
        last = np.diff(offsets)[strand] - 1
        return ((np.arange(len(strand)) - offsets[strand]) / last).astype(np.float32)

    @property
    def st(self) -> Floats:
        """`root_uv (S, 2)` as others have it: t upwards on the images of `layer_image`."""
        return upwards(self.root_uv)

    @property
    def head_st(self) -> Floats | None:
        """`head_uv (V, 2)` as others have it: t upwards, and (-1, -1) off the scalp."""
        if self.head_uv is None:
            return None
        off = np.isnan(self.head_uv)
        return np.where(off, np.float32(-1), upwards(self.head_uv))

    @cached_property
    def looked_up(self) -> tuple[Array, Array]:
        """Absorption `(N, 3)` and correctives `(N, 2)` at the points."""
        return at_points(self.maps, self.strands, self.root_uv)

    def colour(self, sigma_a: AnyFloats) -> Floats:
        """Linear RGB of dense hair of absorption `sigma_a (…, 3)` (Sun 2021, Eq. 11 inverted)."""
        return colour_of_absorption(sigma_a, self.maps.beta_n).astype(np.float32)


def upwards(uv: Array) -> Floats:
    """`uv (N, 2)` of images whose rows go down, with v that goes up."""
    return (uv * (1, -1) + (0, 1)).astype(np.float32)


def clumps(strands: Strands, count: int, seed: int) -> tuple[Ints, Ints]:
    """Indices `(G,)` of `count` guides, or of as many as have a shape, and each strand's `(S,)`.

    k-means of the strands' points at `SHAPE` equal arc lengths; a guide is the strand nearest to
    its cluster's mean.
    """
    if not count or not len(strands):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    shape = shapes(strands).reshape(len(strands), -1)
    start = np.random.default_rng(seed).choice(len(shape), min(count, len(shape)), replace=False)
    with warnings.catch_warnings():
        # strands that are alike leave some: they are guides of no strand, and go below
        warnings.filterwarnings("ignore", "One of the clusters is empty", UserWarning)
        centres, _ = kmeans2(shape, shape[np.sort(start)], iter=8, minit="matrix", missing="warn")
    _, guides = cKDTree(shape).query(centres)
    guides = np.unique(guides)
    _, clump = cKDTree(shape[guides]).query(shape)
    clump[guides] = np.arange(len(guides))  # twins of a guide must not take its place
    return guides, clump


def shapes(strands: Strands, count: int = SHAPE) -> Array:
    """Each strand's points at `count` equal arc lengths `(S, count, 3)`."""
    points, offsets = strands.points.astype(float), strands.offsets
    step = np.zeros(len(points))
    starts = strands.segment_starts
    step[starts + 1] = np.linalg.norm(points[starts + 1] - points[starts], axis=1)
    arc = np.cumsum(step)
    first, length = arc[offsets[:-1]], strands.lengths()
    at = first[:, None] + length[:, None] * np.linspace(0, 1, count)
    left = np.searchsorted(arc, at.ravel(), side="right").reshape(at.shape) - 1
    left = np.clip(left, offsets[:-1, None], offsets[1:, None] - 2)
    span = arc[left + 1] - arc[left]
    share = np.divide(at - arc[left], span, out=np.zeros_like(span), where=span > 0)
    share = np.clip(share, 0, 1)[..., None]
    return points[left] * (1 - share) + points[left + 1] * share


def at_points(maps: HairMaps, strands: Strands, root_uv: Array) -> tuple[Array, Array]:
    """Absorption `(N, 3)` and correctives `(N, 2)` at the strands' points."""
    counts = np.diff(strands.offsets)
    strand = strands.strand_of_point
    along = (np.arange(len(strands.points)) - strands.offsets[:-1][strand]) / (counts[strand] - 1)
    out = []
    for table in (maps.sigma_a, maps.rotation):
        layers, columns, rows, _ = table.shape
        u = np.minimum((root_uv[:, 0] * columns).astype(int), columns - 1)[strand]
        v = np.minimum((root_uv[:, 1] * rows).astype(int), rows - 1)[strand]
        height = along * (layers - 1)
        low = np.minimum(height.astype(int), max(layers - 2, 0))
        share = (height - low)[:, None]
        high = np.minimum(low + 1, layers - 1)
        out.append(table[low, u, v] * (1 - share) + table[high, u, v] * share)
    return out[0], out[1]

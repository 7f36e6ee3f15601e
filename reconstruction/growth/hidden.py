"""Hair that no camera sees: copies of the strands around it, as dense as depths show hair to be.

Light meets the first fibre at exponentially distributed depths (Beer and Lambert). A triangulated
point is seen and lit, so its depth falls off at twice the rate: depths under the hair's surface
deviate by half the mean free path, 1 / (density × a fibre's width).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from reconstruction.arrays import AnyFloats, Array, Bools, Floats, Ints
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.mesh_queries import depth_map, nearest_depth
from reconstruction.geometry.strands import Strands
from reconstruction.geometry.voxels import VoxelGrid
from reconstruction.growth.lines import Surfaces
from reconstruction.growth.selection import exposed
from reconstruction.light_planes import PointCloud

FIBRE = 80e-6
"""Metres: a hair's width (Photobooth §3.4)."""

AROUND = 8e-3
"""Metres around a point in which depths are compared: more than light reaches into hair, some 5 mm,
less than a head or a tail is wide."""

_POINTS, _SAMPLES, _FEW, _ALIKE = 100_000, 4000, 32, 32
"""Most points, those at which depths are compared, fewest neighbours, and values of which one is
the median."""

_CELL = 4e-3  # metres: an edge of the cells in which hair is counted
_STEP = 2e-3  # metres between the points that count
_GAP = 2e-3  # metres between points or strands that cover what is behind
_SHORTEST = 10e-3  # metres below which a copy is dropped, as a strand through a gap is
_MODELS = 64  # nearest points of strands, one of which is copied to a place
_TOGETHER = 2000
_PLACES = 400_000
"""Most places that are tried."""


@dataclass(frozen=True)
class Density:
    """Metres of hair in a cubic metre at `points (N, 3)`: `values (N,)`; and the median over them
    of the `depth` by which hair hides what is behind, metres."""

    points: Array
    values: Array
    depth: float

    def at(self, places: AnyFloats) -> Array:
        """The median of the nearest values at each of `places (M, 3)`."""
        k = np.arange(1, min(_ALIKE, len(self.points)) + 1)
        _, index = cKDTree(self.points).query(places, k=k, workers=-1)
        return np.asarray(np.median(self.values[index], axis=1))


def measured_density(
    points: AnyFloats, given: float | None = None, seed: int = 0
) -> Density | None:
    """The density of hair whose visible `points (N, 3)` were triangulated; None for too few.

    From the deviation of a point's neighbours from their plane, unless it is `given` in metres in a
    cubic centimetre. Locks deviate, too: of hair in locks as few as half of the metres are found.
    """
    some = np.asarray(points, float)[np.random.default_rng(seed).permutation(len(points))[:_POINTS]]
    tree = cKDTree(some)
    kept, depths = [], []
    for i, place in enumerate(some[:_SAMPLES]):
        near = some[tree.query_ball_point(place, AROUND)]
        if len(near) >= _FEW:
            kept.append(i)
            depths.append(np.sqrt(max(np.linalg.eigvalsh(np.cov(near.T))[0], FIBRE**2)))
    if not kept:
        return None
    depth = np.array(depths)
    values = 0.5 / (depth * FIBRE) if given is None else np.full(len(depth), 1e6 * given)
    return Density(some[kept], values, float(np.median(depth)))


class Room:
    """How many metres of hair each cell of an envelope still takes, besides `strands`."""

    def __init__(self, envelope: VoxelGrid, density: Density, strands: Strands) -> None:
        self._grid, self._across = envelope, max(1, round(_CELL / envelope.spacing))
        self._shape = np.array(envelope.inside.shape) // self._across + 1
        cells, voxels = np.unique(self._cells(np.argwhere(envelope.inside)), return_counts=True)
        corner = self._across * np.stack(np.unravel_index(cells, self._shape), axis=1)
        middle = envelope.centers(corner + (self._across - 1) / 2)
        self._left = np.zeros(int(np.prod(self._shape)))
        self._left[cells] = voxels * envelope.spacing**3 * density.at(middle)
        self.total = float(self._left.sum())
        self.take(strands.resampled(_STEP).points)

    @property
    def left(self) -> float:
        """Metres that the cells with room still take."""
        return float(np.maximum(self._left, 0).sum())

    def free(self, points: AnyFloats) -> Bools:
        """Whether each of `points (N, 3)` in the envelope lies in a cell with room for one more."""
        return np.asarray(self._left[self._cells(self._grid.index(points))] >= _STEP)

    def take(self, points: AnyFloats) -> None:
        """Count a strand's `points (N, 3)`, one each 2 mm; those outside the envelope take none."""
        inside = self._grid.index(points[self._grid.contains(points)])
        np.add.at(self._left, self._cells(inside), -_STEP)

    def _cells(self, voxels: Ints) -> Ints:
        return np.asarray(np.ravel_multi_index(tuple((voxels // self._across).T), self._shape))


def seen_by(
    surfaces: Surfaces, cloud: PointCloud, strands: Strands, depth: float
) -> Callable[[AnyFloats], Bools]:
    """Whether some camera may see each of some points `(N, 3)`.

    Up to `depth` behind the hair that its pixels show: where it has points of the `cloud` its
    `surfaces`, elsewhere the first strand, or either within `_GAP` of them. Where there is none, a
    surface is only the envelope's and may be before the hair: there up to `AROUND` behind it.
    """
    dense = strands.resampled(_STEP).points
    known, others = [], []
    for camera, surface in surfaces:
        own = depth_map(camera, cloud.of_camera(camera.name).points)
        first = _without_gaps(camera, nearest_depth(camera, dense))
        near = np.where(own > 0, surface, _without_gaps(camera, own))
        near = np.where(near > 0, near, np.where(first > 0, np.maximum(first, surface), 0.0))
        near = np.where(surface > 0, near, 0.0)
        known.append((camera, near))
        others.append((camera, np.where(near > 0, 0.0, surface)))
    return lambda points: exposed(points, known, depth) | exposed(points, others, AROUND)


def _without_gaps(camera: Camera, depth: Array) -> Array:
    """`depth (H, W)`, that of the nearest known pixel within `_GAP` where it is 0."""
    if not depth.any():
        return depth
    pixels, (y, x) = ndimage.distance_transform_edt(depth == 0, return_indices=True)
    near = depth[y, x]
    return np.where(pixels * near <= _GAP * camera.K[0, 0], near, 0.0)


def hidden_strands(
    strands: Strands,
    envelope: VoxelGrid,
    density: Density,
    seen: Callable[[AnyFloats], Bools],
    *,
    most: int,
    seed: int = 0,
) -> tuple[list[Floats], dict[str, Any]]:
    """Polylines `(N, 3)`, at most `most`, that fill the `envelope` to its `density`; figures.

    For a place without enough hair one of the strands nearby is copied and moved there; models are
    the longest strands, of half of all length. What is `seen (N,)` of a copy's points `(N, 3)` is
    cut off, and a copy is dropped of which less than half is where hair is missing.
    """
    rng = np.random.default_rng(seed)
    room = Room(envelope, density, strands)
    figures = {
        "metres_in_cm3": 1e-6 * float(np.median(density.values)),
        "depth_mm": 1e3 * density.depth,
        "expected_metres": room.total,
        "missing_metres": room.left,
    }
    models = _longer_half(strands).resampled(_STEP)
    tree = cKDTree(models.points, balanced_tree=False, compact_nodes=False)
    counts, owner = np.diff(models.offsets), models.strand_of_point
    voxels = np.argwhere(envelope.inside)
    places = envelope.centers(voxels[rng.permutation(len(voxels))[:_PLACES]])
    places = places[~seen(places)]
    found: list[Floats] = []
    while len(found) < most and len(places):
        places = places[room.free(places)]
        some, places = places[:_TOGETHER], places[_TOGETHER:]
        k = np.arange(1, min(_MODELS, len(models.points)) + 1)
        near = tree.query(some, k=k)[1]
        near = near[np.arange(len(some)), rng.integers(len(k), size=len(some))]
        move = some - models.points[near]
        which = owner[near]
        offsets = np.append(0, np.cumsum(counts[which]))
        copy = np.repeat(np.arange(len(which)), counts[which])
        at = np.arange(offsets[-1]) - offsets[copy] + models.offsets[which][copy]
        points = models.points[at] + move[copy]
        good = envelope.contains(points)
        good[good] = ~seen(points[good])
        for a, b in _longest_runs(good, offsets):
            if (b - a - 1) * _STEP >= _SHORTEST and room.free(points[a:b]).mean() >= 0.5:
                room.take(points[a:b])
                found.append(points[a:b].astype(np.float32))
    found = found[: max(most, 0)]  # a group may go beyond it
    return found, {**figures, "added": len(found), "still_missing_metres": room.left}


def _longer_half(strands: Strands) -> Strands:
    """The longest strands, which have half of the length."""
    lengths = strands.lengths()
    order = np.argsort(-lengths, kind="stable")
    most = int(np.searchsorted(np.cumsum(lengths[order]), 0.5 * lengths.sum())) + 1
    return strands.subset(np.sort(order[:most]))


def _longest_runs(good: Bools, offsets: Ints) -> list[tuple[int, int]]:
    """For each strand's `good (N,)` points the first and past the last of the longest run."""
    out = []
    for a, b in pairwise(offsets.tolist()):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], good[a:b].astype(np.int8), [0]])))
        if len(edges):
            k = 2 * int((edges[1::2] - edges[::2]).argmax())
            out.append((a + int(edges[k]), a + int(edges[k + 1])))
    return out

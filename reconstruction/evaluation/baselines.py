"""Baselines from masks and head alone, and an upper bound from exact directions.

The baselines fill the hull so densely that every point in it is within 1 mm of a line: their errors
come from directions and from the hull's excess volume.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from reconstruction.arrays import Array, Bools
from reconstruction.evaluation.oriented_points import STEP
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.mesh_queries import inside_mesh, mesh_depth, mesh_silhouette
from reconstruction.geometry.strands import Strands
from reconstruction.geometry.voxels import VoxelGrid
from reconstruction.growth.field import DOWN, descent, solve_field
from reconstruction.images.visual_hull import space_carve, trim_edges, visual_hull

SPACING = np.sqrt(2) * 1e-3
"""Metres between neighbouring lines: every point is within 1 mm of one."""

RADIUS = 3.5e-4


def baseline_hull(
    cameras: Sequence[Camera],
    masks: Mapping[str, Bools],
    head: Mesh | None = None,
    *,
    spacing: float = 2e-3,
    bounds: Array | None = None,
) -> VoxelGrid:
    """The possible volume of hair from `masks[camera.name] (H, W)` of the hair and a head.

    The visual hull of hair and head, without the head's inside and without voxels in front of
    pixels that show no hair. Without a head, the visual hull of the masks. Within `bounds (2, 3)`,
    metres; None: where cameras see.
    """
    if head is None:
        return visual_hull(cameras, masks, spacing=spacing, bounds=bounds)
    used = [c for c in cameras if c.name in masks]
    both = {
        c.name: trim_edges(masks[c.name] | mesh_silhouette(c, head), masks[c.name]) for c in used
    }
    hull = visual_hull(used, both, spacing=spacing, bounds=bounds)
    hull = replace(hull, inside=hull.inside & ~inside_mesh(hull, head))
    first = {c.name: np.where(masks[c.name], 0.0, mesh_depth(c, head)) for c in used}
    return space_carve(hull, used, first)


def hull_vertical(hull: VoxelGrid) -> Strands:
    """The hull filled with vertical lines `SPACING` metres apart, upper ends first."""
    low, (x, y, _) = _lattice(hull)
    columns = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    i, j = hull.index(np.column_stack([columns, np.full(len(columns), low[2])])).T[:2]
    inside = np.pad(hull.inside[i, j], ((0, 0), (1, 1))).astype(np.int8)
    column, bottom = np.nonzero(np.diff(inside, axis=1) == 1)
    top = np.nonzero(np.diff(inside, axis=1) == -1)[1]
    ends = np.empty((len(column), 2, 3))
    ends[:, :, :2] = columns[column][:, None]
    ends[:, :, 2] = low[2] + hull.spacing * np.stack([top, bottom], axis=1)
    return Strands(ends.reshape(-1, 3).astype(np.float32), 2 * np.arange(len(ends) + 1), RADIUS)


def _lattice(hull: VoxelGrid) -> tuple[Array, list[Array]]:
    """The hull's lowest corner `(3,)`, and coordinates `SPACING` apart along each axis."""
    low, size = hull.origin - hull.spacing / 2, hull.spacing * np.array(hull.inside.shape)
    return low, [low[a] + np.arange(SPACING / 2, size[a], SPACING) for a in range(3)]


def hull_smooth_field(hull: VoxelGrid, head: Mesh | None = None) -> Strands:
    """The hull filled with a smooth direction field in segments `SPACING` metres long.

    On the outer surface (not where it touches the `head`) the direction is that of steepest
    descent; inside it is interpolated by `solve_field`. Raises `ValueError` for an empty hull.
    """
    points, tangents = descent(hull, inside_mesh(hull, head) if head is not None else None)
    field, _ = solve_field(hull, points, tangents)
    lattice = np.stack(np.meshgrid(*_lattice(hull)[1], indexing="ij"), axis=-1).reshape(-1, 3)
    lattice = lattice[hull.contains(lattice)]
    direction, there = field.sample(lattice, np.broadcast_to(DOWN, lattice.shape))
    center, half = lattice[there], direction[there] * SPACING / 2
    ends = np.stack([center - half, center + half], axis=1)
    return Strands(ends.reshape(-1, 3).astype(np.float32), 2 * np.arange(len(ends) + 1), RADIUS)


def with_true_directions(strands: Strands, true: Strands, width: float) -> Strands:
    """Segments of `strands` with the mean direction of `true` in their cube of `width` metres.

    An upper bound: scores of exact directions at a resolution of `width`. Segments without a true
    strand in their cube keep their direction.
    """
    pieces, dense = strands.resampled(STEP), true.resampled(STEP)
    true_cell, cell = (np.floor(s.points / width).astype(np.int64) for s in (dense, pieces))
    low, high = true_cell.min(axis=0), true_cell.max(axis=0)
    near = np.flatnonzero(((cell >= low) & (cell <= high)).all(axis=1))
    flat = np.ravel_multi_index(
        tuple((np.concatenate([true_cell, cell[near]]) - low).T), tuple(high - low + 1)
    )
    index = np.unique(flat, return_inverse=True)[1]
    of_true, of_near = np.split(index, [len(true_cell)])
    t, count = dense.tangents().astype(float), int(index.max()) + 1
    sums = [np.bincount(of_true, t[:, i] * t[:, j], count) for i, j in np.ndindex(3, 3)]
    tensors = np.stack(sums, axis=1).reshape(-1, 3, 3)
    known = np.trace(tensors, axis1=1, axis2=2)[of_near] > 0
    direction = pieces.tangents().astype(float)
    direction[near[known]] = np.linalg.eigh(tensors)[1][of_near[known], :, -1]
    half = direction * STEP / 2
    ends = np.stack([pieces.points - half, pieces.points + half], axis=1)
    return Strands(ends.reshape(-1, 3).astype(np.float32), 2 * np.arange(len(ends) + 1), RADIUS)

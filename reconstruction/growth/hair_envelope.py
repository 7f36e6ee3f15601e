"""The volume that can hold hair, from masks, triangulated points and the head."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage

from reconstruction.arrays import Array, Bools
from reconstruction.capture.records import CaptureError
from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.mesh_queries import (
    depth_map,
    inside_mesh,
    mesh_depth,
    mesh_silhouette,
    nearest_depth,
)
from reconstruction.geometry.voxels import VoxelGrid
from reconstruction.images.visual_hull import first_depth, space_carve, trim_edges, visual_hull
from reconstruction.light_planes import PointCloud
from reconstruction.masks import MaskedCapture
from reconstruction.plausibility import check_places, check_subject, check_volume
from reconstruction.report.report import Stage

SHELL = 12e-3  # metres: thickness of hair under a hull's surface
_BARE = 2e-3  # metres behind the head's surface up to which a skin pixel excludes hair
_ACROSS = 128  # voxels along the edge of the box in which hair is searched


def build_envelope(
    masked: MaskedCapture,
    cloud: PointCloud,
    head: Mesh,
    *,
    grid: float,
    margin: float,
    stage: Stage,
    longest: float = 0.3,
) -> tuple[VoxelGrid, dict[str, Array]]:
    """The volume that can hold hair, and the depth `(H, W)` of each camera's hair pixels.

    `grid` is the voxels' edge, `margin` how far in front of the visible surface hair may be, and
    `longest` its length, metres.

    The visual hull of the foreground minus the head's inside, carved by free space: voxels in front
    of a triangulated hair pixel, or of the head where the pixel shows skin. Voxels with
    triangulated hair points are kept. Without a sweep, hair pixels carve nothing, and their depth
    is where the ray enters the envelope. Raises `CaptureError` if nothing is left.
    """
    masks, cameras = masked.masks, masked.cameras
    bounds = _bounds(masked, cloud, head, longest)
    hull = visual_hull(
        cameras, {k: m.subject for k, m in masks.items()}, spacing=grid, bounds=bounds
    )
    surfaces, depths, hairs = {}, {}, []
    for camera in cameras:
        mask = masks[camera.name]
        bare = mesh_depth(camera, head) + _BARE + margin
        own = cloud.of_camera(camera.name).points if len(cloud) else cloud.points
        depth = np.where(mask.hair, depth_map(camera, own), 0.0)
        first = np.where(mask.hair, depth, np.where(np.isfinite(bare), bare, 0.0))
        surfaces[camera.name], depths[camera.name] = first, depth
        visible, x, y, _ = camera.pixels_of(own)
        hairs.append(own[visible & mask.hair[y, x]])
    carved = space_carve(hull, cameras, surfaces, margin)
    held = hull.inside & _holding(hull, np.concatenate(hairs))
    inside = (carved.inside | held) & ~inside_mesh(hull, head)
    envelope = replace(carved, inside=inside)
    for camera in cameras:
        depth = depths[camera.name]
        unknown = masks[camera.name].hair & (depth == 0)
        depths[camera.name] = np.where(unknown, nearest_depth(camera, envelope.centers()), depth)
    litres = 1e3 * grid**3
    stage.figures.update(
        hull_litres=float(hull.inside.sum() * litres),
        carved_litres=float(carved.inside.sum() * litres),
        envelope_litres=float(inside.sum() * litres),
        voxels=int(inside.sum()),
        shape=list(inside.shape),
    )
    stage.leave_out(
        "voxels outside the envelope",
        "they cannot contain hair",
        f"{inside.size - int(inside.sum())} of {inside.size} unknowns",
    )
    if not inside.any():
        raise CaptureError(
            f"{masked.capture.path}: no volume is left for hair: check masks, head.obj and poses"
        )
    check_places(masked.capture.rig, hull)
    check_volume(masked, envelope, "the volume that can hold hair", stage)
    return envelope, depths


def build_hull(
    masked: MaskedCapture, *, grid: float, stage: Stage
) -> tuple[VoxelGrid, Bools, dict[str, Array]]:
    """As `build_envelope` without sweep and head: the part of the subject's hull that can be hair.

    If skin is visible, voxels within `SHELL` metres of those that more cameras show as hair than as
    skin. Also the rest of the hull's voxels `(X, Y, Z)`, and the depths `(H, W)` by camera.
    Raises `CaptureError` where nothing is left, or too few cameras see hair.
    """
    hull = envelope = masked.subject_hull(grid)
    check_places(masked.capture.rig, hull)
    check_subject(masked, hull, stage)
    hair, skin = _shown(hull, masked)
    if skin.any():
        near = hair.any() and ndimage.distance_transform_edt(~hair, sampling=grid) <= SHELL
        envelope = replace(hull, inside=hull.inside & near & ~skin)
    litres = 1e3 * grid**3
    if not envelope.inside.any():
        raise CaptureError(
            f"{masked.capture.path}: no volume is left for hair: check masks and poses"
        )
    stage.figures.update(
        hull_litres=float(hull.inside.sum() * litres),
        envelope_litres=float(envelope.inside.sum() * litres),
        voxels=int(envelope.inside.sum()),
    )
    check_volume(masked, hull, "the visual hull", stage)
    stage.warn("no head: the volume under the hair counts as hair, and strands have no roots")
    depths = {
        c.name: np.where(masked.masks[c.name].hair, nearest_depth(c, envelope.centers()), 0.0)
        for c in masked.cameras
    }
    return envelope, hull.inside & ~envelope.inside, depths


def _shown(hull: VoxelGrid, masked: MaskedCapture) -> tuple[Bools, Bools]:
    """Voxels `hull.inside.shape` that more cameras show as hair than as skin, and the reverse."""
    centers, votes = hull.centers(), np.zeros(int(hull.inside.sum()), np.int64)
    for camera in masked.cameras:
        mask = masked.masks[camera.name]
        visible, x, y, depth = camera.pixels_of(centers)
        near = visible & (depth <= first_depth(camera, hull)[y, x] + SHELL)
        votes[near] += mask.hair[y, x][near]
        votes[near] -= mask.skin[y, x][near]
    hair, skin = np.zeros((2, *hull.inside.shape), bool)
    hair[hull.inside], skin[hull.inside] = votes > 0, votes < 0
    return hair, skin


def _holding(grid: VoxelGrid, points: Array) -> Bools:
    """Voxels `grid.inside.shape` with at least two of `points (N, 3)`."""
    index = grid.index(points)
    index = index[((index >= 0) & (index < grid.inside.shape)).all(axis=1)]
    flat = np.ravel_multi_index(tuple(index.T), grid.inside.shape)
    counts = np.bincount(flat, minlength=grid.inside.size)
    return np.asarray(counts.reshape(grid.inside.shape) >= 2)


def _bounds(masked: MaskedCapture, cloud: PointCloud, head: Mesh, longest: float) -> Array:
    """A box `(2, 3)` around the hair: the points', or else 12 cm about the head's upper part and
    the hull of hair and head within `longest` metres of it."""
    if len(cloud) >= 100:
        low, high = np.percentile(cloud.points, [0.1, 99.9], axis=0)
        return np.stack([low - 0.015, high + 0.015])
    top = head.vertices[:, 2].max()
    upper = head.vertices[head.vertices[:, 2] > top - 0.25]
    low, high = upper.min(axis=0), upper.max(axis=0)
    reach = np.stack([low - longest, high + longest])
    hair = {c.name: masked.masks[c.name].hair for c in masked.cameras}
    both = {
        c.name: trim_edges(hair[c.name] | mesh_silhouette(c, head), hair[c.name])
        for c in masked.cameras
    }
    both = {name: mask for name, mask in both.items() if mask.any()}
    edge = float(np.ptp(reach, axis=0).max()) / _ACROSS
    there = visual_hull(masked.cameras, both, spacing=edge, bounds=reach).centers()
    box = [low - 0.12, high + 0.12]
    return np.stack(
        [np.vstack([box, there - edge]).min(axis=0), np.vstack([box, there + edge]).max(axis=0)]
    )

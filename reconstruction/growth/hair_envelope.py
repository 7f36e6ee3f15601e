"""The volume that can hold hair, from masks, triangulated points and the head."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import ndimage

from reconstruction.arrays import Array, Bools
from reconstruction.capture.folder import CaptureError
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.mesh_queries import (
    depth_map,
    inside_mesh,
    mesh_depth,
    mesh_silhouette,
)
from reconstruction.geometry.voxels import VoxelGrid
from reconstruction.head.lit_skin import first_depth
from reconstruction.images.visual_hull import space_carve, trim_edges, visual_hull
from reconstruction.light_planes import PointCloud
from reconstruction.masks import MaskedCapture
from reconstruction.report.report import Stage

SHELL = 12e-3  # metres under a hull's surface that what is seen there may be deep
_BARE = 2e-3  # metres behind the head's surface up to which a pixel of skin rules hair out
_ACROSS = 128  # voxels along the edge of the box in which hair is looked for


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

    `grid` is the voxels' edge, `margin` how far in front of the seen surface hair may be, and
    `longest` how long it is, metres.

    The visual hull of everything that is not background, less the head's inside, less what a
    camera saw through: voxels in front of a triangulated hair pixel, or on the head and in front of
    it where the pixel shows skin. A pixel has one depth and may look past a thin wisp: where
    triangulated points of hair stand, there is hair. Without a sweep, hair pixels carve nothing,
    and their depth is where the ray enters the envelope.
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
        seen, x, y, _ = camera.pixels_of(own)
        hairs.append(own[seen & mask.hair[y, x]])
    carved = space_carve(hull, cameras, surfaces, margin)
    held = hull.inside & _holding(hull, np.concatenate(hairs))
    inside = (carved.inside | held) & ~inside_mesh(hull, head)
    envelope = replace(carved, inside=inside)
    for camera in cameras:
        depth = depths[camera.name]
        unknown = masks[camera.name].hair & (depth == 0)
        depths[camera.name] = np.where(unknown, depth_map_first(camera, envelope), depth)
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
        "no hair can be there",
        f"{inside.size - int(inside.sum())} of {inside.size} unknowns",
    )
    if not inside.any():
        raise CaptureError(
            f"{masked.capture.path}: no volume is left for hair: check masks, head.obj and poses"
        )
    return envelope, depths


def build_hull(
    masked: MaskedCapture, *, grid: float, stage: Stage
) -> tuple[VoxelGrid, Bools, dict[str, Array]]:
    """As `build_envelope` without sweep and head: what of the subject's hull can be hair.

    Where skin is seen that is what is at most `SHELL` metres from where more cameras show hair than
    skin, under the hull's surface: a head has an inside, and a face hides hair but does not carve
    it. Also the rest of the hull's voxels `(X, Y, Z)`, and the depths `(H, W)` by camera.

    Raises `CaptureError` where nothing is left, or too few cameras see hair.
    """
    hull = envelope = masked.subject_hull(grid)
    hair, skin = _shown(hull, masked)
    if skin.any():
        # of a volume without any hair there is no distance to it
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
    stage.warn("no head: what lies under the hair counts as hair, and no strand has a root")
    depths = {
        c.name: np.where(masked.masks[c.name].hair, depth_map_first(c, envelope), 0.0)
        for c in masked.cameras
    }
    return envelope, hull.inside & ~envelope.inside, depths


def _shown(hull: VoxelGrid, masked: MaskedCapture) -> tuple[Bools, Bools]:
    """Voxels `hull.inside.shape` that more cameras show as hair than as skin, and the reverse."""
    centers, votes = hull.centers(), np.zeros(int(hull.inside.sum()), np.int64)
    for camera in masked.cameras:
        mask = masked.masks[camera.name]
        seen, x, y, depth = camera.pixels_of(centers)
        near = seen & (depth <= first_depth(camera, hull)[y, x] + SHELL)
        votes[near] += mask.hair[y, x][near]
        votes[near] -= mask.skin[y, x][near]
    hair, skin = np.zeros((2, *hull.inside.shape), bool)
    hair[hull.inside], skin[hull.inside] = votes > 0, votes < 0
    return hair, skin


def pixel_size(cameras: Sequence[Camera], middle: Array) -> float:
    """Metres that one pixel spans at `middle (3,)`, the median over the cameras."""
    return float(np.median([c.project(middle[None])[1][0] / c.K[0, 0] for c in cameras]))


def _holding(grid: VoxelGrid, points: Array) -> Bools:
    """Voxels `grid.inside.shape` with at least two of `points (N, 3)`."""
    index = grid.index(points)
    index = index[((index >= 0) & (index < grid.inside.shape)).all(axis=1)]
    flat = np.ravel_multi_index(tuple(index.T), grid.inside.shape)
    counts = np.bincount(flat, minlength=grid.inside.size)
    return np.asarray(counts.reshape(grid.inside.shape) >= 2)


def depth_map_first(camera: Camera, envelope: VoxelGrid) -> Array:
    """Depth `(H, W)` at which each pixel's ray meets the envelope, 0 where it does not."""
    seen, x, y, depth = camera.pixels_of(envelope.centers())
    out = np.full((camera.height, camera.width), np.inf)
    np.minimum.at(out, (y[seen], x[seen]), depth[seen])
    return np.where(np.isfinite(out), out, 0.0)


def _bounds(masked: MaskedCapture, cloud: PointCloud, head: Mesh, longest: float) -> Array:
    """A box `(2, 3)` that holds the hair: the points', or 12 cm about the head's upper part.

    Without points also what the hull of hair and head has within `longest` metres of that part.
    """
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

"""The range of depths of a pixel's hair, from the visual hull and the head."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy import ndimage

from reconstruction.arrays import Bools, Floats
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.mesh_queries import inside_mesh
from reconstruction.geometry.voxels import VoxelGrid
from reconstruction.images.visual_hull import visual_hull

DEEPEST = 0.06  # metres behind where a ray enters the volume


def hair_volume(
    cameras: Sequence[Camera], subject: Mapping[str, Bools], head: Mesh | None, spacing: float
) -> VoxelGrid:
    """Voxels that can hold hair: in the hull of the masks `(H, W)` of the subject, off the head.

    `spacing` is the voxels' edge in metres. Line stereo needs points in three views, or two of two.
    """
    used = {c.name: subject[c.name] for c in cameras if subject[c.name].any()}
    hull = visual_hull(cameras, used, spacing=spacing, least_views=3)
    inside = hull.inside & ~inside_mesh(hull, head) if head is not None else hull.inside
    return VoxelGrid(hull.origin, hull.spacing, inside)


def depth_range(camera: Camera, volume: VoxelGrid) -> tuple[Floats, Floats]:
    """Nearest and furthest depth `(H, W)` of the volume behind each pixel, both 0 without any.

    At most `DEEPEST` metres apart.
    """
    near = np.zeros((camera.height, camera.width), np.float32)
    centers = volume.centers()
    pixels, depth = camera.project(centers) if len(centers) else (np.zeros((0, 2)), np.zeros(0))
    ok = (depth > volume.spacing) & np.isfinite(pixels).all(axis=1)
    pixels, depth = pixels[ok], depth[ok]
    if not len(depth):
        return near, near.copy()
    # tiles as large as a voxel's projection leave no gaps between the voxels' centres
    focal = max(camera.K[0, 0], camera.K[1, 1])
    tile = max(1, int(np.ceil(focal * volume.spacing / float(depth.min()))))
    shape = -(-camera.height // tile) + 2, -(-camera.width // tile) + 2
    column, row = (np.floor((pixels + 0.5) / tile).astype(np.int64) + 1).T
    on = (column >= 0) & (row >= 0) & (column < shape[1]) & (row < shape[0])
    first, last = np.full(shape, np.inf), np.full(shape, -np.inf)
    np.minimum.at(first, (row[on], column[on]), depth[on])
    np.maximum.at(last, (row[on], column[on]), depth[on])
    first = ndimage.minimum_filter(first, 3)[1:-1, 1:-1] - volume.spacing
    last = ndimage.maximum_filter(last, 3)[1:-1, 1:-1] + volume.spacing
    last = np.minimum(last, first + DEEPEST)
    y, x = np.arange(camera.height) // tile, np.arange(camera.width) // tile
    found = np.isfinite(first)[np.ix_(y, x)]
    return (
        np.where(found, first[np.ix_(y, x)], 0).astype(np.float32),
        np.where(found, last[np.ix_(y, x)], 0).astype(np.float32),
    )

"""Images of a moved subject, resampled to the image of its reference pose."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from reconstruction.arrays import Array, Floats
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.voxels import VoxelGrid
from reconstruction.images.visual_hull import first_depth, surface_points


@dataclass(frozen=True, eq=False)
class Warp:
    """Where pixels of a camera's images in the reference pose are in those of another one."""

    camera: Camera
    small: Camera
    surface: Array
    by: int

    @classmethod
    def of(cls, camera: Camera, hull: VoxelGrid, by: int) -> Warp:
        """With the depth of the hull, beside it that of its nearest pixel, in reduced pixels."""
        small = camera.reduced(by)
        depth = first_depth(small, hull)
        there = np.isfinite(depth)
        if there.any():
            nearest = ndimage.distance_transform_edt(
                ~there, return_distances=False, return_indices=True
            )
            depth = depth[tuple(nearest)]
            # squares as wide as a voxel are smoothed
            voxel = hull.spacing * small.K[0, 0] / float(np.median(depth))
            depth = cv2.GaussianBlur(depth, (0, 0), max(voxel, 0.5))
        else:
            depth = np.full_like(depth, float(np.linalg.norm(small.center)))
        return cls(camera, small, surface_points(small, depth), by)

    def maps(self, turn: Array, shift: Array) -> tuple[Floats, Floats]:
        """Coordinates x, y `(H, W)` in the image of the subject moved by the pose."""
        moved, _ = self.small.project(self.surface @ turn.T + shift)
        still, _ = self.small.project(self.surface)
        flow = ((moved - still) * self.by).astype(np.float32)
        size = self.camera.width, self.camera.height
        if self.by > 1:  # a rest at the edges is shorter than a reduced pixel
            h, w = flow.shape[0] * self.by, flow.shape[1] * self.by
            flow = cv2.resize(flow, (w, h), interpolation=cv2.INTER_LINEAR)
            rest = size[1] - h, size[0] - w
            flow = cv2.copyMakeBorder(flow, 0, rest[0], 0, rest[1], cv2.BORDER_REPLICATE)
        x, y = np.meshgrid(*(np.arange(n, dtype=np.float32) for n in size))
        return x + flow[..., 0], y + flow[..., 1]

"""The visual hull: the largest volume that agrees with every camera's mask."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import ArrayLike

from reconstruction.arrays import AnyFloats, Array, Bools, Ints
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.voxels import VoxelGrid

BLOCK = 8  # voxels along the edge of the blocks that are carved as a whole before single voxels are
MOST_VOXELS = 400_000_000


def visual_hull(
    cameras: Sequence[Camera],
    masks: Mapping[str, Bools],
    *,
    spacing: float,
    bounds: ArrayLike | None = None,
    least_views: int = 2,
) -> VoxelGrid:
    """Carve the volume that projects into `masks[camera.name] (H, W) bool` of every camera.

    A voxel belongs to the hull if its centre falls on the mask of every camera whose image it falls
    on, and it falls on at least `least_views` images (or all, if there are fewer). An image that a
    voxel misses carves it too, except past an edge that the mask touches: there the image may cut
    the subject off. A camera without a mask takes no part. The masks are of everything that the
    hull shall hold: where a head hides hair, give both together (see `mesh_silhouette`).

    `spacing` is in metres; `bounds (2, 3)` gives the lowest and highest corner, by default the
    hull's own box is found.

    Raises `ValueError` when no camera has a mask, a mask's shape is not its camera's, a mask is
    empty, or the grid would be absurdly large.
    """
    if not spacing > 0:
        raise ValueError(f"spacing must be positive, got {spacing}")
    views = [_MaskView(c, masks[c.name]) for c in cameras if c.name in masks]
    if not views:
        raise ValueError(
            f"no camera has a mask: cameras {[c.name for c in cameras]}, masks {sorted(masks)}"
        )
    least = min(least_views, len(views))
    box = np.asarray(bounds, float) if bounds is not None else _find_bounds(views, least)
    if box.shape != (2, 3) or not (box[1] > box[0]).all():
        raise ValueError(f"bounds must be (2, 3), lowest corner first, got {box.tolist()}")
    shape = np.maximum(np.ceil((box[1] - box[0]) / spacing), 1).astype(np.int64)
    if np.prod(shape.astype(float)) > MOST_VOXELS:
        whole = [v.camera.name for v in views if v.mask.mean() > 0.95]
        hint = f"; the masks of {', '.join(whole)} fill their pictures: " if whole else ""
        hint += "is the background dark? else give clean plates or masks of the subject" * bool(
            whole
        )
        size = f"a grid of {shape.tolist()} voxels is too large"
        raise ValueError(f"{size}: take a spacing above {spacing} m{hint}")
    return VoxelGrid(box[0] + spacing / 2, spacing, _carve(views, box[0], spacing, shape, least))


class _MaskView:
    """A camera, its mask, and for every pixel the distance (pixels) to the mask or to its edge."""

    def __init__(self, camera: Camera, mask: Bools) -> None:
        mask = np.asarray(mask, bool)
        if mask.shape != (camera.height, camera.width):
            raise ValueError(
                f"{camera.name}: its mask must be {(camera.height, camera.width)}, got {mask.shape}"
            )
        if not mask.any():
            raise ValueError(f"{camera.name}: its mask is empty; leave the camera out instead")
        self.camera, self.mask = camera, mask
        self.focal = max(camera.K[0, 0], camera.K[1, 1])
        # where the mask touches an edge of the image, the subject may go on beyond that edge
        sides = mask[:, 0].any(), mask[0].any(), mask[:, -1].any(), mask[-1].any()
        self.left, self.top, self.right, self.bottom = (np.inf if s else 0.5 for s in sides)
        self.cropped = any(sides)
        framed = np.pad(mask, 1)  # beyond the image nothing is surely inside
        self.within = cv2.distanceTransform(framed.astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
        if mask.all():  # OpenCV has no distance to a background that is not there
            self.outside = np.zeros(mask.shape, np.float32)
        else:
            self.outside = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)

    def cut_off(self, points: Array, radius: float = 0.0) -> Bools:
        """Whether balls about `points (M, 3)` reach past an edge where the subject may go on."""
        pixels, depth = self.camera.project(points)
        front = depth > 1e-6
        reach = 1.5 * self.focal * radius / np.maximum(depth - radius, 1e-9)
        x, y = pixels.T
        width, height = self.camera.width, self.camera.height
        allowed = (x >= -self.left - reach) & (x < width - 1 + self.right + reach)
        allowed &= (y >= -self.top - reach) & (y < height - 1 + self.bottom + reach)
        off = (x < -0.5 + reach) | (x >= width - 0.5 - reach)
        off |= (y < -0.5 + reach) | (y >= height - 0.5 - reach)
        return np.asarray(front & allowed & off)

    def on_mask(self, points: Array) -> Bools:
        """Whether `points (M, 3)` fall on a pixel of the mask. The carve's hot loop."""
        c = self.camera
        x, y, z = (c.K @ c.R) @ points.T + (c.K @ c.t)[:, None]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            column, row = x / z + 0.5, y / z + 0.5
        on = (z > 0) & (column >= 0) & (row >= 0) & (column < c.width) & (row < c.height)
        flat = row[on].astype(np.int32) * c.width + column[on].astype(np.int32)
        on[on] = self.mask.ravel()[flat]
        return on

    def balls(self, points: Array, radius: float) -> tuple[Bools, Bools]:
        """Whether balls about `points (M, 3)` may touch the mask, and surely lie within it."""
        pixels, depth = self.camera.project(points)
        # a ball's outline grows towards the image's edges; 1.5 covers 48 degrees off the axis
        reach = 1.5 * self.focal * radius / np.maximum(depth - radius, 1e-9) + 1.5
        size = np.array([self.camera.width, self.camera.height])
        near = np.clip(np.rint(pixels), 0, size - 1)
        column, row = near.astype(np.int64).T
        off = np.abs(pixels - near).max(axis=1)
        touches = (depth > -radius) & (off <= reach) & (self.outside[row, column] <= reach)
        within = (depth > radius) & (off <= 0.5) & (self.within[row, column] > reach)
        return touches, within


def _balls(views: list[_MaskView], points: Array, radius: float, least: int) -> tuple[Bools, Bools]:
    """Whether balls about `points (M, 3)` may hold a part of the hull, and are wholly inside it."""
    alive, whole = np.arange(len(points)), np.ones(len(points), bool)
    count = np.zeros(len(points), np.int64)
    for view in views:
        touches, within = view.balls(points[alive], radius)
        count[alive] += touches
        whole[alive] &= within
        if view.cropped:
            touches |= view.cut_off(points[alive], radius)
        alive = alive[touches]
    out = np.zeros(len(points), bool)
    out[alive] = count[alive] >= least
    return out, out & whole


def _points(views: list[_MaskView], points: Array, least: int) -> Bools:
    """Whether `points (M, 3)` are inside the hull."""
    alive, count = np.arange(len(points)), np.zeros(len(points), np.int64)
    for view in views:
        keep = view.on_mask(points[alive])
        count[alive] += keep
        if view.cropped:
            keep |= view.cut_off(points[alive])
        alive = alive[keep]
    out = np.zeros(len(points), bool)
    out[alive] = count[alive] >= least
    return out


def _carve(views: list[_MaskView], low: Array, spacing: float, shape: Ints, least: int) -> Bools:
    """The inside voxels `shape`: blocks of `BLOCK`³, then the voxels of those that are mixed."""
    blocks = -(-shape // BLOCK)
    out = np.zeros((*blocks, BLOCK, BLOCK, BLOCK), bool)
    edge = BLOCK * spacing
    ijk = _indices(blocks)
    some, whole = _balls(views, low + edge * (ijk + 0.5), edge * np.sqrt(3) / 2, least)
    i, j, k = ijk[whole].T
    out[i, j, k] = True
    local = spacing * (_indices(np.full(3, BLOCK)) + 0.5)
    mixed = ijk[some & ~whole]
    for chunk in np.array_split(mixed, max(1, len(mixed) // 256)):
        voxels = (low + edge * chunk[:, None] + local).reshape(-1, 3)
        i, j, k = chunk.T
        out[i, j, k] = _points(views, voxels, least).reshape(-1, BLOCK, BLOCK, BLOCK)
    voxels = out.transpose(0, 3, 1, 4, 2, 5).reshape(blocks * BLOCK)
    return voxels[: shape[0], : shape[1], : shape[2]]


def _indices(shape: Ints) -> Ints:
    """All voxel indices `(M, 3)` of a grid."""
    return np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, 3)


def _find_bounds(views: list[_MaskView], least: int) -> Array:
    """A box `(2, 3)` around the hull: a coarse carve around the masks' common centre, thrice."""
    center = _common_center(views)
    distance = min(float(np.linalg.norm(v.camera.center - center)) for v in views)
    box = np.stack([center - 0.9 * distance, center + 0.9 * distance])
    for _ in range(3):
        edge = float((box[1] - box[0]).max()) / 48
        shape = np.ceil((box[1] - box[0]) / edge).astype(np.int64)
        centers = box[0] + edge * (_indices(shape) + 0.5)
        alive = centers[_balls(views, centers, edge * np.sqrt(3) / 2, least)[0]]
        if not len(alive):
            raise ValueError(
                "the masks have no volume in common: are the cameras' poses and masks of one scene?"
            )
        box = np.stack([alive.min(axis=0) - edge, alive.max(axis=0) + edge])
    return box


def _common_center(views: list[_MaskView]) -> Array:
    """The point nearest to the rays through the masks' centroids, in the least-squares sense."""
    A, b = np.zeros((3, 3)), np.zeros(3)
    for view in views:
        row, column = np.argwhere(view.mask).mean(axis=0)
        ray = view.camera.rays([column, row])
        across = np.eye(3) - np.outer(ray, ray)
        A += across
        b += across @ view.camera.center
    if np.linalg.cond(A) > 1e6:
        raise ValueError("the masked cameras all look the same way: give bounds for the hull")
    return np.asarray(np.linalg.solve(A, b))


def trim_edges(mask: Bools, hair: Bools) -> Bools:
    """`mask (H, W)` without the pixels on the image's edges that `hair (H, W)` does not hold.

    A neck runs out of most images where the hair does not. The hull of masks trimmed like this
    ends at such an edge instead of going on beyond it.
    """
    out = mask.copy()
    for side in (np.s_[0], np.s_[-1], np.s_[:, 0], np.s_[:, -1]):
        out[side] &= hair[side]
    return out


def space_carve(
    hull: VoxelGrid,
    cameras: Sequence[Camera],
    first_surface: Mapping[str, AnyFloats],
    margin: float = 0.0,
) -> VoxelGrid:
    """The hull without the voxels that some camera saw through (space carving).

    `first_surface[name] (H, W)` is the depth along that camera's z, metres, of the first thing
    each pixel sees: infinite where the pixel sees nothing at all, 0 where nothing is known. Voxels
    more than `margin` metres in front of it are empty; voxels off an image are not judged by it.
    """
    index = np.argwhere(hull.inside)
    for camera in (c for c in cameras if c.name in first_surface):
        first = first_surface[camera.name]
        if first.shape != (camera.height, camera.width):
            size = (camera.height, camera.width)
            raise ValueError(f"{camera.name}: first_surface must be {size}, got {first.shape}")
        seen, x, y, depth = camera.pixels_of(hull.centers(index))
        index = index[~seen | (depth >= first[y, x] - margin)]
    inside = np.zeros_like(hull.inside)
    inside[tuple(index.T)] = True
    return replace(hull, inside=inside)

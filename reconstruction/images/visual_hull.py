"""The visual hull: the largest volume consistent with every camera's mask."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import ArrayLike

from reconstruction.arrays import AnyFloats, Array, Bools, Ints
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.voxels import VoxelGrid

BLOCK = 8  # voxels along the edge of the blocks that are tested first
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

    A voxel is inside if its centre projects into the mask of every camera whose image contains it,
    and into at least `least_views` images (or all, if fewer). Outside an image it is removed,
    except beyond an edge that the mask touches, where the image may crop the subject. Cameras
    without a mask are ignored. If a head hides hair, the masks must hold both (see
    `mesh_silhouette`).

    `spacing` is in metres; `bounds (2, 3)` are the lowest and highest corner, by default the hull's
    box.

    Raises `ValueError` without a mask, for a mask of a wrong shape, an empty mask, or more than
    `MOST_VOXELS` voxels.
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
        hint = ""
        if whole:
            hint = (
                f"; the masks of {', '.join(whole)} fill their images: if the background is lit, "
            )
            hint += "provide clean plates or masks of the subject"
        size = f"a grid of {shape.tolist()} voxels is too large"
        raise ValueError(f"{size}: use a spacing above {spacing} m{hint}")
    return VoxelGrid(box[0] + spacing / 2, spacing, _carve(views, box[0], spacing, shape, least))


class _MaskView:
    """A camera, its mask, and each pixel's distance to the mask's edge in pixels."""

    def __init__(self, camera: Camera, mask: Bools) -> None:
        mask = np.asarray(mask, bool)
        if mask.shape != (camera.height, camera.width):
            raise ValueError(
                f"{camera.name}: its mask must be {(camera.height, camera.width)}, got {mask.shape}"
            )
        if not mask.any():
            raise ValueError(f"{camera.name}: its mask is empty: omit the camera")
        self.camera, self.mask = camera, mask
        self.focal = max(camera.K[0, 0], camera.K[1, 1])
        # the subject may continue beyond an edge that the mask touches
        sides = mask[:, 0].any(), mask[0].any(), mask[:, -1].any(), mask[-1].any()
        self.left, self.top, self.right, self.bottom = (np.inf if s else 0.5 for s in sides)
        self.cropped = any(sides)
        framed = np.pad(mask, 1)  # outside the image nothing is certainly inside
        self.within = cv2.distanceTransform(framed.astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
        if mask.all():  # OpenCV needs a background
            self.outside = np.zeros(mask.shape, np.float32)
        else:
            self.outside = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)

    def cut_off(self, points: Array, radius: float = 0.0) -> Bools:
        """Whether balls at `points (M, 3)` extend past an edge that may crop the subject."""
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
        """Whether `points (M, 3)` project into the mask; the hot loop."""
        c = self.camera
        x, y, z = (c.K @ c.R) @ points.T + (c.K @ c.t)[:, None]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            column, row = x / z + 0.5, y / z + 0.5
        on = (z > 0) & (column >= 0) & (row >= 0) & (column < c.width) & (row < c.height)
        flat = row[on].astype(np.int32) * c.width + column[on].astype(np.int32)
        on[on] = self.mask.ravel()[flat]
        return on

    def balls(self, points: Array, radius: float) -> tuple[Bools, Bools]:
        """Whether balls at `points (M, 3)` may touch the mask, and certainly project inside it."""
        pixels, depth = self.camera.project(points)
        # outlines grow towards the image edges; 1.5 covers 48 degrees off the axis
        reach = 1.5 * self.focal * radius / np.maximum(depth - radius, 1e-9) + 1.5
        size = np.array([self.camera.width, self.camera.height])
        near = np.clip(np.rint(pixels), 0, size - 1)
        column, row = near.astype(np.int64).T
        off = np.abs(pixels - near).max(axis=1)
        touches = (depth > -radius) & (off <= reach) & (self.outside[row, column] <= reach)
        within = (depth > radius) & (off <= 0.5) & (self.within[row, column] > reach)
        return touches, within


def _balls(views: list[_MaskView], points: Array, radius: float, least: int) -> tuple[Bools, Bools]:
    """Whether balls at `points (M, 3)` may intersect the hull, and are entirely inside it."""
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
    """Inside voxels of a grid of `shape`: blocks of `BLOCK`³ first, then voxels of mixed blocks."""
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
    """A box `(2, 3)` around the hull, by three coarse hulls around the masks' common centre."""
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
                "the masks have no volume in common: check that camera poses and masks "
                "are of one scene"
            )
        box = np.stack([alive.min(axis=0) - edge, alive.max(axis=0) + edge])
    return box


def _common_center(views: list[_MaskView]) -> Array:
    """The least-squares intersection of the rays through the masks' centroids."""
    A, b = np.zeros((3, 3)), np.zeros(3)
    for view in views:
        row, column = np.argwhere(view.mask).mean(axis=0)
        ray = view.camera.rays([column, row])
        across = np.eye(3) - np.outer(ray, ray)
        A += across
        b += across @ view.camera.center
    if np.linalg.cond(A) > 1e6:
        raise ValueError("the masked cameras have parallel axes: give bounds for the hull")
    return np.asarray(np.linalg.solve(A, b))


def trim_edges(mask: Bools, hair: Bools) -> Bools:
    """`mask (H, W)` without pixels on the image edges that are not `hair (H, W)`.

    Most images crop the neck but not the hair; the hull of trimmed masks ends at such an edge.
    """
    out = mask.copy()
    for side in (np.s_[0], np.s_[-1], np.s_[:, 0], np.s_[:, -1]):
        out[side] &= hair[side]
    return out


def first_depth(camera: Camera, hull: VoxelGrid) -> Array:
    """Depth `(H, W)` of the hull's nearest voxel along z, metres, infinite without one.

    In squares of pixels as wide as a voxel, since finer pixels miss voxel centres.
    """
    centers = hull.centers()
    inside, x, y, depth = camera.pixels_of(centers)
    size = hull.spacing * camera.K[0, 0] / float(np.median(depth)) if len(depth) else 1.0
    square = max(1, int(np.ceil(size)))
    first = np.full((camera.height // square + 1, camera.width // square + 1), np.inf)
    np.minimum.at(first, (y[inside] // square, x[inside] // square), depth[inside])
    rows, columns = (np.arange(n) // square for n in (camera.height, camera.width))
    return np.asarray(first[np.ix_(rows, columns)])


def surface_points(camera: Camera, depth: Array) -> Array:
    """World positions `(H, W, 3)` at `depth (H, W)` along z."""
    grid = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1)
    rays = camera.rays(grid)
    return np.asarray(camera.center + rays * (depth / (rays @ camera.R[2]))[..., None])


def space_carve(
    hull: VoxelGrid,
    cameras: Sequence[Camera],
    first_surface: Mapping[str, AnyFloats],
    margin: float = 0.0,
) -> VoxelGrid:
    """Space carving: the hull without voxels in front of a camera's first visible surface.

    `first_surface[name] (H, W)` is the depth of that surface along the camera's z, metres: infinite
    where nothing is visible, 0 where unknown. Voxels more than `margin` metres in front of it are
    removed.
    """
    index = np.argwhere(hull.inside)
    for camera in (c for c in cameras if c.name in first_surface):
        first = first_surface[camera.name]
        if first.shape != (camera.height, camera.width):
            size = (camera.height, camera.width)
            raise ValueError(f"{camera.name}: first_surface must be {size}, got {first.shape}")
        inside, x, y, depth = camera.pixels_of(hull.centers(index))
        index = index[~inside | (depth >= first[y, x] - margin)]
    inside = np.zeros_like(hull.inside)
    inside[tuple(index.T)] = True
    return replace(hull, inside=inside)

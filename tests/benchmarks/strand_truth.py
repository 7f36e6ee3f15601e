"""What strands are scored against, and what they are compared with."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from reconstruction import Camera, Capture, Model, Strands, read_strands
from reconstruction.arrays import Array
from reconstruction.capture_scale import pixel_size
from reconstruction.evaluation.baselines import (
    baseline_hull,
    hull_smooth_field,
    hull_vertical,
    with_true_directions,
)
from reconstruction.evaluation.matching import compare_strands
from reconstruction.evaluation.visibility import Visibility
from reconstruction.geometry.mesh_queries import mesh_depth
from reconstruction.geometry.voxels import VoxelGrid

STEP = 5e-4
"""Metres between the points at which strands are cut at a ball's surface."""


@dataclass(frozen=True)
class Ball:
    """The part of space that is judged, metres."""

    center: tuple[float, float, float]
    radius: float

    def holds(self, points: ArrayLike, margin: float = 0.0) -> Array:
        """Whether each of `points (N, 3)` lies in it, or within `margin` of it."""
        return np.linalg.norm(np.asarray(points) - self.center, axis=1) < self.radius + margin

    def cut(self, strands: Strands) -> Strands:
        """The pieces of the strands that lie in it, resampled at half a millimetre."""
        dense = strands.resampled(STEP)
        inside = self.holds(dense.points)
        owner = dense.strand_of_point
        starts = inside & ~np.r_[False, inside[:-1] & (owner[1:] == owner[:-1])]
        piece = np.cumsum(starts)[inside]
        points = dense.points[inside]
        count = np.bincount(piece)[1:] if len(piece) else np.zeros(0, np.int64)
        keep = np.repeat(count >= 2, count)
        offsets = np.concatenate([[0], np.cumsum(count[count >= 2])]).astype(np.int64)
        return Strands(points[keep], offsets, float(np.mean(strands.radius)))

    def within(self, hull: VoxelGrid, margin: float) -> VoxelGrid:
        """The voxels whose centres it holds, on a grid no larger than it."""
        c, reach = np.asarray(self.center, float), self.radius + margin
        low, high = hull.index(np.stack([c - reach, c + reach]))
        low, high = np.maximum(low, 0), np.minimum(high + 1, hull.inside.shape)
        part = hull.inside[tuple(slice(a, max(a, b)) for a, b in zip(low, high, strict=True))]
        out = VoxelGrid(hull.origin + low * hull.spacing, hull.spacing, part.copy())
        out.inside[out.inside] = self.holds(out.centers(), margin)
        return out


def write_hair_masks(capture: Capture, truth_folder: Path) -> None:
    """Write the user's masks of a capture that has none, from its true strands.

    Sun's come from a network trained for it; a patch has no background by which to tell hair.
    """
    strands = read_strands(truth_folder / "strands.npz")
    points = strands.resampled(STEP).points
    (capture.path / "masks").mkdir(exist_ok=True)
    for camera in capture.rig.cameras:
        file = capture.path / "masks" / f"{camera.name}.png"
        if file.exists():
            continue
        pixels, depth = camera.project(points)
        on = (depth > 0) & camera.inside(pixels)
        x, y = np.rint(pixels[on]).astype(int).T
        nearest = np.full((camera.height, camera.width), np.inf)
        np.minimum.at(nearest, (y, x), depth[on])
        nearest = ndimage.minimum_filter(nearest, 3)  # strands are two to three pixels wide
        skin = np.inf if capture.head is None else mesh_depth(camera, capture.head)
        cv2.imwrite(str(file), (nearest < skin).astype(np.uint8) * 255)


class StrandTruth:
    """True strands, of a `ball` only where one is given, and what the cameras see of them."""

    def __init__(
        self, capture: Capture, folder: Path, ball: Ball | None = None, samples: int = 40_000
    ) -> None:
        self.whole = whole = read_strands(folder / "strands.npz")
        self._capture, self._ball, self._samples = capture, ball, samples
        self.strands = whole if ball is None else ball.cut(whole)
        self._visibility = Visibility(capture.rig.cameras, whole, capture.head)

    def score(self, strands: Strands) -> dict[str, Any]:
        """`compare_strands` of what lies in the ball, over visible and all."""
        return compare_strands(
            strands if self._ball is None else self._ball.cut(strands),
            self.strands,
            samples=self._samples,
            visibility=self._visibility,
        )

    def swept(self, strands: Strands) -> dict[str, Any]:
        """Scores of what cameras see and a projector lights: all that a sweep can place.

        `share` is that of what cameras see. Stripes are taken to be as fine as the truth.
        """
        projectors = [
            Camera(name=p.name, K=p.K, R=p.R, t=p.t, width=p.width, height=p.height)
            for p in self._capture.rig.projectors
        ]
        lit = Visibility(projectors, self.strands, self._capture.head)
        visible_from = self._visibility
        score = compare_strands(
            strands,
            self.strands,
            samples=self._samples,
            visibility=lambda p: visible_from(p) & lit(p),
        )
        points = self.strands.resampled(4 * STEP).points
        points = points[visible_from(points)]
        return {"share": float(lit(points).mean()), **score["visible"]}

    def baselines(self, model: Model, spacing: float = 2e-3) -> dict[str, dict[str, Any]]:
        """Scores of what uses no method, in the masks that `model`'s reconstruction had.

        And of its strands as the truth turns them over a pixel.
        """
        capture = self._capture
        masks = {c.name: model.mask(c.name, "hair", capture) for c in capture.rig.cameras}
        bounds = None  # cameras that see a patch bound no hull
        if self._ball is not None:
            reach = self._ball.radius + 2 * spacing
            bounds = np.array(self._ball.center) + reach * np.array([[-1.0], [1.0]])
        hull = baseline_hull(
            capture.rig.cameras, masks, capture.head, spacing=spacing, bounds=bounds
        )
        if self._ball is not None:
            hull = self._ball.within(hull, spacing)
        pixel = pixel_size(capture.rig.cameras, self.strands.points.mean(axis=0, dtype=float))
        ours = model.strands() if self._ball is None else self._ball.cut(model.strands())
        turned = with_true_directions(ours, self.strands, pixel)
        return {
            "true_directions": self.score(turned),
            "hull_vertical": self.score(hull_vertical(hull)),
            "hull_smooth_field": self.score(hull_smooth_field(hull, capture.head)),
        }

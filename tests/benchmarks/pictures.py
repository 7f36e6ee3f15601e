"""What a reconstruction looks like: points, directions in a slice, strands on a photograph."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.results import new_figure
from reconstruction import Camera, Capture, Strands
from reconstruction.arrays import Floats
from reconstruction.light_planes import PointCloud

_SLAB = 1.5e-3  # metres to each side of a slice


def picture_model(
    path: Path, capture: Capture, cloud: PointCloud, strands: Strands, most: int = 6000
) -> None:
    """Four panels as one PNG at `path`, of the capture's second camera.

    Its photograph under all lights, the triangulated points by depth, the strands drawn over the
    photograph by direction, and the directions in the plane x = 0: |x|, |y|, |z| of a tangent are
    its red, green and blue. At most `most` strands are drawn.
    """
    camera = capture.rig.cameras[min(1, len(capture.rig.cameras) - 1)]
    photograph = _exposed(capture.frame(capture.of_kind("all_on")[0], camera.name))
    figure = new_figure(4, 1, (3.5, 4.6))
    panels = figure.subplots(1, 4)
    panels[0].imshow(photograph)
    pixels, depth = camera.project(cloud.points)
    visible = np.flatnonzero((depth > 0) & camera.inside(pixels))
    order = visible[np.argsort(-depth[visible])]
    panels[1].scatter(*pixels[order].T, c=depth[order], s=0.3, linewidths=0, cmap="viridis")
    panels[1].set(xlim=(0, camera.width), ylim=(camera.height, 0), aspect="equal")
    panels[2].imshow(_drawn(photograph // 2, camera, strands, most))
    tangents = np.abs(strands.tangents())
    slab = np.flatnonzero(np.abs(strands.points[:, 0]) < _SLAB)
    panels[3].scatter(
        *strands.points[slab][:, 1:].T * 1e3, c=np.clip(tangents[slab], 0, 1), s=1, linewidths=0
    )
    panels[3].set(aspect="equal", xlabel="y, mm", ylabel="z, mm")
    titles = ("under all lights", "points by depth", "strands by direction", "slice x = 0")
    for axes, title in zip(panels, titles, strict=True):
        axes.set_title(title, loc="left", fontsize=10)
    for axes in panels[:3]:
        axes.axis("off")
    figure.savefig(path, dpi=90)


def picture_strands(path: Path, camera: Camera, sets: Mapping[str, Strands]) -> None:
    """Strands as the camera sees them, nearest first, side by side as a PNG at `path`.

    The nearest point of each pixel has a colour by its tangent in the camera's frame: |x|, |y|, |z|
    are red, green and blue. The head is not drawn: what lies behind is seen through gaps.
    """
    figure = new_figure(len(sets))
    for axes, (title, strands) in zip(figure.subplots(1, len(sets)), sets.items(), strict=True):
        dense = strands.resampled(2e-4)
        pixels, depth = camera.project(dense.points)
        on = np.flatnonzero((depth > 0) & camera.inside(pixels))
        on = on[np.argsort(-depth[on])]
        x, y = np.rint(pixels[on]).astype(int).T
        canvas = np.zeros((camera.height, camera.width, 3))
        canvas[y, x] = np.abs(dense.tangents()[on] @ camera.R.T)  # the last one stays
        axes.imshow(np.clip(canvas, 0, 1))
        axes.set_title(title, loc="left", fontsize=10)
        axes.axis("off")
    figure.savefig(path, dpi=90)


def picture_motion(path: Path, clouds: Mapping[str, PointCloud]) -> None:
    """The same slice |x| < 1.5 mm through each of `clouds` side by side, as a PNG."""
    figure = new_figure(len(clouds), 1, (4.6, 4.8))
    panels = figure.subplots(1, len(clouds), squeeze=False)[0]
    for axes, (title, cloud) in zip(panels, clouds.items(), strict=True):
        slab = np.abs(cloud.points[:, 0]) < _SLAB
        axes.scatter(*cloud.points[slab][:, 1:].T * 1e3, s=1, linewidths=0, color="#0f6e84")
        axes.set(aspect="equal", xlabel="y, mm", ylabel="z, mm")
        axes.set_title(title, loc="left", fontsize=10)
    figure.savefig(path, dpi=90)


def _exposed(image: Floats) -> NDArray[np.uint8]:
    white = max(float(np.percentile(image, 99.5)), 1e-12)
    return (np.clip(image / white, 0, 1) ** (1 / 2.2) * 255).astype(np.uint8)


def _drawn(
    photograph: NDArray[np.uint8], camera: Camera, strands: Strands, most: int
) -> NDArray[np.uint8]:
    scale, shift = 3, 4  # drawn larger than the photograph; OpenCV's bits below the pixel
    canvas = cv2.resize(photograph, None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST)
    tangents = np.abs(strands.tangents())
    chosen = np.random.default_rng(0).permutation(len(strands))[:most]
    pixels, depth = camera.project(strands.points)
    middle = depth[(strands.offsets[:-1] + strands.offsets[1:]) // 2]
    at = np.rint((pixels * scale + (scale - 1) / 2) * (1 << shift)).astype(np.int32)
    for i in chosen[np.argsort(-middle[chosen])]:
        part = slice(strands.offsets[i], strands.offsets[i + 1])
        colour = np.clip(tangents[part].mean(axis=0), 0, 1) * 255
        line = [at[part][:, None]]
        cv2.polylines(canvas, line, False, colour.tolist(), 1, cv2.LINE_AA, shift)
    return np.asarray(canvas, np.uint8)

"""Visibility of points behind strands and head, by z-buffers of points."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from reconstruction.arrays import AnyFloats, Array, Bools, Floats, Ints
from reconstruction.evaluation.oriented_points import require_hair
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.mesh_queries import surface_samples
from reconstruction.geometry.strands import Resampling, Strands

NARROWEST, WIDEST = 5e-4, 1e-3  # metres: limits of the occluding width of a strand
MOST_PIXELS = 64_000_000
CHUNK = 200_000


class Visibility:
    """Visibility in `cameras` of points behind `strands` and `head`.

    A point is visible in a camera if it projects into its image and lies at most the tolerance
    (along the camera's axis) behind the nearest part of strands and head in its pixel of a
    z-buffer. Independent of the cameras' resolution, a pixel spans one strand width (twice the
    median radius, 0.5 to 1 mm) at the strands' median depth.

    Raises as `require_hair` does.
    """

    def __init__(self, cameras: Sequence[Camera], strands: Strands, head: Mesh | None = None):
        require_hair(strands)
        width = 2 * float(np.median(strands.radius)) if len(strands) else NARROWEST
        pixel = float(np.clip(width, NARROWEST, WIDEST))
        dense = Resampling(strands, pixel)
        count = int(dense.offsets[-1])
        some, _ = dense(np.arange(0, count, max(1, count // 500_000)))
        corners = None if head is None else head.vertices
        self._buffers = [_DepthBuffer(camera, some, pixel, corners) for camera in cameras]
        for first in range(0, count if self._buffers else 0, CHUNK):
            points, _ = dense(np.arange(first, min(first + CHUNK, count)))
            for buffer in self._buffers:
                buffer.splat(points)
        if head is None or not self._buffers:
            return
        covering = np.any([b.over(head) for b in self._buffers], axis=0)
        if covering.any():
            # under √3/2, so that no pixel is missed
            spacing = 0.7 * min(b.span for b in self._buffers)
            part = Mesh(head.vertices, head.faces[covering])
            samples = surface_samples(part, spacing)[0].astype(np.float32)
            for buffer in self._buffers:
                buffer.splat(samples)

    def depth_maps(self) -> dict[str, dict[str, AnyFloats]]:
        """The z-buffers by pinhole camera, which suffice for the test of visibility.

        `depth (H, W)` in metres, infinite where nothing is; `matrix (3, 4)` from the world to
        homogeneous pixels of the map, whose third row gives the depth; `image (2, 2)`, first and
        last corner of the camera's image in these pixels.
        """
        return {
            b.lens.name: {
                "depth": b.depth.reshape(b.shape),
                "matrix": np.hstack([b.A, b.b]),
                "image": b.image,
            }
            for b in self._buffers
        }

    def __call__(self, points: AnyFloats, tolerance: float = 1e-3) -> Bools:
        """Which of `points (N, 3)` are visible in at least one camera, `(N,)`."""
        out = np.zeros(len(points), bool)
        for buffer in self._buffers:
            todo = np.flatnonzero(~out)
            out[todo] = buffer.sees(points[todo], tolerance)
        return out


class _DepthBuffer:
    """The nearest depth in every pixel of a pinhole image of the strands and the `head (V, 3)`.

    The camera's own lens only determines which points project into its image.
    """

    def __init__(
        self, camera: Camera, strands: AnyFloats, pixel: float, head: AnyFloats | None = None
    ) -> None:
        self.lens = camera
        self.camera = camera = camera.pinhole()
        pixels, depth = camera.project(strands)
        front = depth > 1e-6
        self.scale, self.low, self.shape, self.span = 1.0, np.zeros(2), (1, 1), pixel
        if front.any():
            focal = max(camera.K[0, 0], camera.K[1, 1])
            self.scale = float(np.median(depth[front])) / (focal * pixel)
            first, end = _picture(self.lens, camera)
            self.low = np.clip(pixels[front].min(axis=0), first, end)
            extent = np.clip(pixels[front].max(axis=0), first, end) - self.low
            wanted = float(np.prod(extent * self.scale + 2))
            self.scale *= min(1.0, float(np.sqrt(MOST_PIXELS / wanted)))
            width, height = np.ceil(extent * self.scale).astype(int) + 1
            self.shape = (int(height), int(width))
            # nearer parts are imaged larger and need denser samples
            self.span = float(np.quantile(depth[front], 0.02)) / (focal * self.scale)
            if head is not None:
                pixels, depth = camera.project(head)
                self._extend(np.clip(pixels[depth > 1e-6], first, end))
        self.depth = np.full(self.shape[0] * self.shape[1], np.inf, np.float32)
        # world to homogeneous buffer pixels; the third row gives the depth
        to_buffer = np.diag([self.scale, self.scale, 1.0])
        to_buffer[:2, 2] = -self.scale * self.low
        self.A = (to_buffer @ camera.K @ camera.R).astype(np.float32)
        self.b = (to_buffer @ camera.K @ camera.t).astype(np.float32)[:, None]
        corners = np.array([[-0.5, -0.5], [camera.width - 0.5, camera.height - 0.5]])
        self.image = (corners - self.low) * self.scale

    def _extend(self, pixels: Array) -> None:
        """Enlarge the buffer to contain `pixels (N, 2)`, if memory allows."""
        if not len(pixels):
            return
        at, size = (pixels - self.low) * self.scale, np.array(self.shape[::-1])
        before = np.maximum(np.ceil(-at.min(axis=0)), 0)
        size = before + np.maximum(size, np.floor(at.max(axis=0)) + 1)
        if np.prod(size) <= MOST_PIXELS:
            self.low = self.low - before / self.scale
            self.shape = (int(size[1]), int(size[0]))

    def _project(self, points: AnyFloats) -> Iterator[tuple[slice, Floats, Floats, Floats]]:
        """By chunk: slice, column, row and depth; behind the camera the column is -inf."""
        for first in range(0, len(points), CHUNK):
            part = slice(first, first + CHUNK)
            x, y, z = self.A @ points[part].astype(np.float32).T + self.b
            front = z > 1e-6
            x = np.divide(x, z, out=np.full_like(x, -np.inf), where=front)
            y = np.divide(y, z, out=y, where=front)
            yield part, x, y, z

    def splat(self, points: AnyFloats) -> None:
        for _, x, y, z in self._project(points):
            on, flat = self._pixels(x, y)
            np.minimum.at(self.depth, flat, z[on])

    def sees(self, points: AnyFloats, tolerance: float) -> Bools:
        out = np.zeros(len(points), bool)
        (left, top), (right, bottom) = self.image
        for part, x, y, z in self._project(points):
            if self.lens.distorted:
                visible = (x > -np.inf) & self.lens.inside(self.lens.project(points[part])[0])
            else:
                visible = (x >= left) & (y >= top) & (x < right) & (y < bottom)
            on, flat = self._pixels(x, y)
            visible[on] &= z[on] <= self.depth[flat] + np.float32(tolerance)
            out[part] = visible
        return out

    def _pixels(self, x: Floats, y: Floats) -> tuple[Bools, Ints]:
        """Which points project into the buffer, and their pixels."""
        height, width = self.shape
        on = (x >= 0) & (y >= 0) & (x < width) & (y < height)
        return on, y[on].astype(np.int64) * width + x[on].astype(np.int64)

    def over(self, mesh: Mesh) -> Bools:
        """Which faces `(F,)` may cover the buffer: in front of the camera, over its rectangle."""
        pixels, depth = self.camera.project(mesh.vertices)
        front = (depth[mesh.faces] > 1e-6).all(axis=1)
        corners = (pixels[mesh.faces] - self.low) * self.scale
        size = np.array(self.shape[::-1])
        over = (corners.max(axis=1) >= 0).all(axis=1) & (corners.min(axis=1) < size).all(axis=1)
        return np.asarray(front & over)


def _picture(lens: Camera, pinhole: Camera) -> Array:
    """First and last column and row `(2, 2)` in `pinhole`'s image of the image through `lens`."""
    end = np.array([lens.width, lens.height]) - 0.5
    if not lens.distorted:
        return np.stack([np.full(2, -0.5), end])
    grid = np.stack(np.meshgrid(*(np.linspace(-0.5, e, 17) for e in end)), axis=-1)
    pixels = pinhole.project(lens.center + lens.rays(grid))[0].reshape(-1, 2)
    return np.stack([pixels.min(axis=0), pixels.max(axis=0)])

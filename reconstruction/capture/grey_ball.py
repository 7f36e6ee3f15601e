"""Radiometric scale from a matt grey ball in view.

A Lambertian ball of albedo ρ has the radiance ρ/π · I cos θ/d² under a point light of intensity I
at the distance d and the angle θ to the normal. Its position follows from its outlines.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.ndimage import map_coordinates

from reconstruction.arrays import Array, Bools, Floats
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.lights import Light
from reconstruction.options import options

Circle = tuple[float, float, float]
"""x, y and radius in pixels."""
POINTS = 600
"""Sample points on the ball."""
FACING, LIT = 0.6, 0.3
"""Least cosines to the camera and to the light of a sample: edges and terminators are blurred."""
FEWEST = 20
"""Samples required in a frame."""
MEET = 0.5
"""Largest distance between rays through the outlines' centres, in units of the radius."""
DISAGREE = 0.1
"""Robust spread of frames about their median that causes a note."""


@options
class GreyBall:
    """A matt ball of known `albedo` in view of at least two cameras.

    `circles` are its outlines by camera: x, y and radius in pixels, the centre of the top-left
    pixel at (0, 0).
    """

    circles: dict[str, Circle]
    albedo: Annotated[float, Field(gt=0, le=1)] = 0.18


@options
class MirrorBalls:
    """Mirror balls of one `radius` in metres and their outlines in each camera, as in `GreyBall`.

    They are detected without `circles`; without a radius two cameras place a ball.
    """

    radius: Annotated[float, Field(gt=0)] | None = None
    circles: dict[str, list[Circle]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class PlacedBall:
    """A ball at `center (3,)` with a `radius` in metres and outlines in the named `cameras`."""

    center: Array
    radius: float
    albedo: float
    cameras: tuple[str, ...]

    @classmethod
    def of(cls, ball: GreyBall, cameras: Mapping[str, Camera]) -> PlacedBall:
        """Position and radius from the outlines. Raises `ValueError` naming what does not fit."""
        if unknown := sorted(set(ball.circles) - set(cameras)):
            raise ValueError(f"circles: no camera {unknown[0]!r}")
        if len(ball.circles) < 2:
            raise ValueError("circles: give the ball's outline in two cameras or more")
        names = tuple(ball.circles)
        circles = np.array([ball.circles[n] for n in names])
        if not np.isfinite(circles).all() or not (circles[:, 2] > 0).all():
            raise ValueError("circles: expected x, y and a positive radius in pixels")
        centers = np.array([cameras[n].center for n in names])
        rays = np.array([cameras[n].rays(c[:2]) for n, c in zip(names, circles, strict=True)])
        across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
        total = across.sum(axis=0)
        if np.linalg.cond(total) > 1e6:
            raise ValueError("circles: the cameras view the ball from one direction")
        center = np.linalg.solve(total, np.einsum("nij,nj->i", across, centers))
        rim = circles[:, None, 2:] * [[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]
        rim = circles[:, None, :2] + rim
        edges = np.array([cameras[n].rays(r) for n, r in zip(names, rim, strict=True)])
        sine = np.linalg.norm(np.cross(edges, rays[:, None]), axis=-1).mean(axis=1)
        distance = np.linalg.norm(center - centers, axis=1)
        radius = float(np.median(sine * distance))
        off = np.linalg.norm(np.einsum("nij,nj->ni", across, center - centers), axis=1)
        if off.max() > MEET * radius:
            worst = names[int(off.argmax())]
            raise ValueError(
                f"circles: the ray of {worst} misses the ball by {1e3 * off.max():.0f} mm at a "
                f"radius of {1e3 * radius:.0f} mm: check the outlines and the camera poses"
            )
        return cls(center, radius, ball.albedo, names)

    def factor(self, camera: Camera, light: Light, image: Floats, bad: Bools) -> Array | None:
        """Factor `(3,)` from `image (H, W, 3)` under one light to W/(sr m²).

        `bad (H, W)` are saturated pixels. None if fewer than `FEWEST` samples are visible and lit.
        """
        normals = _directions(POINTS)
        points = self.center + self.radius * normals
        eye, towards = camera.center - points, light.position - points
        squared = (towards**2).sum(axis=1)
        cosine = (normals * towards).sum(axis=1) / np.sqrt(squared)
        facing = (normals * eye).sum(axis=1) / np.linalg.norm(eye, axis=1)
        pixels, _ = camera.project(points)
        used = (facing > FACING) & (cosine > LIT) & camera.inside(pixels)
        x, y = np.rint(pixels[used]).astype(int).T
        good = ~bad[np.clip(y, 0, bad.shape[0] - 1), np.clip(x, 0, bad.shape[1] - 1)]
        used[used] = good
        if used.sum() < FEWEST:
            return None
        place = pixels[used].T[::-1]
        found = np.array(
            [map_coordinates(c, place, order=1, mode="nearest") for c in image.transpose(2, 0, 1)]
        )
        share = (cosine / squared)[used, None]
        sent = self.albedo / np.pi * light.intensity_towards(points[used]) * share
        observed = found.mean(axis=1)
        return None if not (observed > 0).all() else np.asarray(sent.mean(axis=0) / observed)


@dataclass(frozen=True)
class Scale:
    """W/(sr m²) of an image value of 1, with its standard error; `notes` for the user."""

    value: float
    error: float
    notes: tuple[str, ...]

    @classmethod
    def of(cls, factors: Sequence[Array]) -> Scale:
        """The median of `PlacedBall.factor` over frames. Raises `ValueError` for none."""
        if not factors:
            raise ValueError("no frame shows the lit side of the ball: check the circles")
        whole = np.array(factors)
        # a frame whose light is occluded is a one-sided outlier
        logs = np.log(whole.mean(axis=1))
        middle = float(np.median(logs))
        spread = 1.4826 * float(np.median(np.abs(logs - middle)))
        channels = np.median(whole / whole.mean(axis=1, keepdims=True), axis=0)
        notes = []
        if spread > DISAGREE:
            notes.append(f"grey ball: frames disagree by {spread:.0%}: is it in shadow, or glossy?")
        if np.abs(channels - 1).max() > 0.05:
            notes.append(
                "grey ball: its images are coloured; multiply red, green and blue by "
                + ", ".join(f"{c:.2f}" for c in channels)
                + " (white balance of the camera)"
            )
        error = spread * np.sqrt(np.pi / 2 / len(logs))
        return cls(float(np.exp(middle)), float(error), tuple(notes))


def _directions(count: int) -> Array:
    """Unit vectors `(count, 3)` of a Fibonacci lattice."""
    k = np.arange(count) + 0.5
    z, turn = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
    flat = np.sqrt(1 - z * z)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)

"""W/(sr m²) from a matt grey ball in view: its light under one light is known, a picture's is not.

A Lambertian ball of albedo ρ sends ρ/π · I cos θ/d² towards every camera from where a point light
of intensity I stands at the distance d and under the angle θ to the normal. Nothing else is asked
of the ball than where it lies, and that is seen.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field
from scipy.ndimage import map_coordinates

from reconstruction.arrays import Array, Bools, Floats
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.lights import Light
from reconstruction.options import options

POINTS = 600
"""Points all over the ball."""
FACING, LIT = 0.6, 0.3
"""Cosines to the camera and to the light from which on a point is used: edges blur, and terminators
are soft."""
FEWEST = 20
"""Points that a frame must show."""
MEET = 0.5
"""Of the ball's radius, how far rays through the circles' middles may pass each other."""
DISAGREE = 0.1
"""Robust spread of frames about their median above which a user is told."""


@options
class GreyBall:
    """A matt ball of known `albedo` in view of at least two cameras.

    `circles` are its outlines by camera: x, y and radius in pixels, the centre of the top-left
    pixel at (0, 0).
    """

    circles: dict[str, tuple[float, float, float]]
    albedo: Annotated[float, Field(gt=0, le=1)] = 0.18


@dataclass(frozen=True, eq=False)
class PlacedBall:
    """A ball about `center (3,)`, of a `radius` in metres, seen by the cameras named in `seen`."""

    center: Array
    radius: float
    albedo: float
    seen: tuple[str, ...]

    @classmethod
    def of(cls, ball: GreyBall, cameras: Mapping[str, Camera]) -> PlacedBall:
        """Where the outlines say that it lies. Raises `ValueError` naming what does not fit."""
        if unknown := sorted(set(ball.circles) - set(cameras)):
            raise ValueError(f"circles: there is no camera {unknown[0]!r}")
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
            raise ValueError("circles: the cameras see the ball from one direction")
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
                f"circles: the one of {worst} passes the others' ball by {1e3 * off.max():.0f} mm, "
                f"its radius is {1e3 * radius:.0f} mm: is it the same ball, are cameras right?"
            )
        return cls(center, radius, ball.albedo, names)

    def factor(self, camera: Camera, light: Light, image: Floats, bad: Bools) -> Array | None:
        """What `image (H, W, 3)` of one light is to be multiplied by, `(3,)`, for W/(sr m²).

        `bad (H, W)` are saturated pixels. None where too little of the ball is seen and lit.
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
        found = np.array([map_coordinates(c, place, order=1) for c in image.transpose(2, 0, 1)])
        share = (cosine / squared)[used, None]
        sent = self.albedo / np.pi * light.intensity_towards(points[used]) * share
        seen = found.mean(axis=1)
        return None if not (seen > 0).all() else np.asarray(sent.mean(axis=0) / seen)


@dataclass(frozen=True)
class Scale:
    """W/(sr m²) of a picture's 1, with its standard error; `notes` for the user."""

    value: float
    error: float
    notes: tuple[str, ...]

    @classmethod
    def of(cls, factors: Sequence[Array]) -> Scale:
        """The median over frames of `PlacedBall.factor`. Raises `ValueError` without any."""
        if not factors:
            raise ValueError("no frame shows the lit side of the ball: are the circles on it?")
        whole = np.array(factors)
        # a frame whose light something stands before is far off, and to one side
        logs = np.log(whole.mean(axis=1))
        middle = float(np.median(logs))
        spread = 1.4826 * float(np.median(np.abs(logs - middle)))
        channels = np.median(whole / whole.mean(axis=1, keepdims=True), axis=0)
        notes = []
        if spread > DISAGREE:
            notes.append(
                f"the grey ball: frames disagree by {spread:.0%}: is it in shadow, or shiny?"
            )
        if np.abs(channels - 1).max() > 0.05:
            notes.append(
                "the grey ball looks coloured: red, green and blue would have to be multiplied by "
                + ", ".join(f"{c:.2f}" for c in channels)
                + "; that is left to the camera's white balance"
            )
        error = spread * np.sqrt(np.pi / 2 / len(logs))
        return cls(float(np.exp(middle)), float(error), tuple(notes))


def _directions(count: int) -> Array:
    """Unit vectors `(count, 3)`, spread evenly: the points of a Fibonacci lattice."""
    k = np.arange(count) + 0.5
    z, turn = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
    flat = np.sqrt(1 - z * z)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)

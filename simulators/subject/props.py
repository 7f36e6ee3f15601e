"""Calibration targets: a ChArUco board, a mirror or a diffuse sphere.

They are convex and alone, so they have no indirect light, and ray casting with the cameras' lens
model is exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import erfinv

from reconstruction import Camera, Light, Rig
from reconstruction.arrays import Array, Ints
from reconstruction.calibration.boards import Board
from reconstruction.geometry.cameras import facing
from simulators.frames.responses import Response

LAMP_RADIUS = 4e-3  # metres, of lamps without a radius


@dataclass(frozen=True, eq=False)
class PropSamples:
    """Samples `(P, S)` of a prop in the flat `pixels (P,)` of a camera.

    `points` and `normals (P, S, 3)`, and `albedo (P, S)`, 0 where the ray misses.
    """

    pixels: Ints
    points: Array
    normals: Array
    albedo: Array


@dataclass(frozen=True, eq=False)
class BoardProp:
    """`board` at `x_world = rotation @ x_board + translation`, printed on stiff white card.

    A quiet zone of a quarter square surrounds the print. Lambertian; its back is black.
    """

    board: Board
    rotation: Array
    translation: Array
    white: float = 0.8
    black: float = 0.04

    def sample(self, camera: Camera, offsets: Array) -> PropSamples:
        """Samples at pixel centres plus `offsets (S, 2)`."""
        pixels, rays = _rays(camera, offsets, self._outline())
        origin = (camera.center - self.translation) @ self.rotation
        local = rays @ self.rotation
        front = (origin[2] < 0) & (local[..., 2] > 1e-9)
        distance = np.where(front, -origin[2] / np.where(front, local[..., 2], 1.0), 0.0)
        at = origin[:2] + distance[..., None] * local[..., :2]
        rim = 0.25 * self.board.square
        on = front & ((at > -rim) & (at < self.board.size + rim)).all(axis=-1)
        kept = on.any(axis=1)
        pixels, rays, at, on, distance = (a[kept] for a in (pixels, rays, at, on, distance))
        albedo = np.where(self.board.ink(at), self.black, self.white) * on
        points = camera.center + distance[..., None] * rays
        normal = np.broadcast_to(-self.rotation[:, 2], points.shape)
        return PropSamples(pixels, points, normal, albedo)

    def to_dict(self) -> dict[str, Any]:
        """The true pose, ready for JSON."""
        return {"rotation": self.rotation.tolist(), "translation": self.translation.tolist()}

    def _outline(self) -> Array:
        rim = 0.25 * self.board.square
        x, y = self.board.size + rim
        corners = np.array([[-rim, -rim, 0], [x, -rim, 0], [x, y, 0], [-rim, y, 0]])
        return corners @ self.rotation.T + self.translation


@dataclass(frozen=True, eq=False)
class SphereProp:
    """A sphere at `centre (3,)` of `radius`, metres: Lambertian of `albedo`, or a mirror of it."""

    centre: Array
    radius: float
    albedo: float
    mirror: bool = False

    def sample(self, camera: Camera, offsets: Array) -> PropSamples:
        """Samples at pixel centres plus `offsets (S, 2)`."""
        box = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T
        pixels, rays = _rays(camera, offsets, self.centre + self.radius * box)
        towards = self.centre - camera.center
        along = rays @ towards
        inside = along**2 - (towards @ towards - self.radius**2)
        distance = along - np.sqrt(np.maximum(inside, 0))
        points = camera.center + distance[..., None] * rays
        normals = (points - self.centre) / self.radius
        return PropSamples(pixels, points, normals, np.where(inside > 0, self.albedo, 0.0))

    def to_dict(self) -> dict[str, Any]:
        """The true place, ready for JSON."""
        place = {"centre": self.centre.tolist(), "radius": self.radius}
        return {**place, "albedo": self.albedo, "mirror": self.mirror}


Prop = BoardProp | SphereProp


def board_pose(number: int, board: Board) -> BoardProp:
    """The board in the pose `number`: one turn about the stage in 16, tilted and off the centre."""
    rng = np.random.default_rng([number, 0xB0A2D])
    azimuth, elevation = np.radians([22.5 * number + rng.uniform(-8, 8), rng.uniform(-25, 40)])
    outwards = np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), 0]
    )
    outwards[2] = np.sin(elevation)
    rotation = facing(-outwards, rng.uniform(-40, 40)).T
    middle = rng.uniform(-0.035, 0.035, 3)
    half = np.append(board.size / 2, 0)
    return BoardProp(board, rotation, middle - rotation @ half)


class PropResponder:
    """A `Responder` of a prop, which is the same at every pose."""

    def __init__(self, rig: Rig, prop: Prop, samples: int = 4) -> None:
        self._rig, self._prop, self._samples = rig, prop, samples

    def lights(self, camera: str) -> Response:
        """See `Responder.lights`."""
        device = self._rig.camera(camera)
        if isinstance(self._prop, SphereProp) and self._prop.mirror:
            return _glints(self._prop, device, self._rig.lights)
        seen = self._prop.sample(device, _offsets(device, self._samples))
        points, normals, albedo = seen.points, seen.normals, seen.albedo
        if isinstance(self._prop, BoardProp):  # light varies little over a pixel of a plane
            points, normals = points.mean(axis=1, keepdims=True), normals[:, :1]
            albedo = albedo.mean(axis=1, keepdims=True)
        images = np.zeros((len(self._rig.lights), len(points), 3), np.float32)
        for image, light in zip(images, self._rig.lights, strict=True):
            arriving = light.intensity_towards(points)
            share = albedo * _form(light.position - points, normals) / np.pi
            image[:] = (share[..., None] * arriving).mean(axis=1)
        return Response(seen.pixels, images)

    def lights_together(self, camera: str, pose: int, power: Array) -> Response:
        """See `Responder.lights_together`; `power (L,)`."""
        response = self.lights(camera)
        images = np.tensordot(power.astype(np.float32), response.images, 1)
        return Response(response.pixels, images[None].astype(np.float32))

    def sweep(self, camera: str, pose: int) -> dict[str, Response]:
        """See `Responder.sweep`."""
        device = self._rig.camera(camera)
        seen = self._prop.sample(device, _offsets(device, self._samples))
        mirror = isinstance(self._prop, SphereProp) and self._prop.mirror
        out = {}
        for p in self._rig.projectors:
            at, depth = p.project(seen.points)
            share = seen.albedo * _form(p.center - seen.points, seen.normals) / np.pi
            share = share * (p.inside(at) & (depth > 0)) * (not mirror)
            images = np.zeros((p.height, len(share), 3), np.float32)
            nearest = np.clip(np.rint(at[..., 1]), -9, p.height + 9).astype(int)
            reach = int(np.ceil(4 * p.line_sigma + 0.5))
            pixel = np.broadcast_to(np.arange(len(share))[:, None], share.shape)
            for step in range(-reach, reach + 1):
                row = nearest + step
                light = share * p.row_weight(row, at[..., 1]) / share.shape[1]
                ok = (row >= 0) & (row < p.height) & (light > 0)
                np.add.at(images, (row[ok], pixel[ok]), light[ok][:, None] * p.intensity)
            out[p.name] = Response(seen.pixels, images)
        return out


def reflection(eye: Array, lamp: Array, centre: Array, radius: float) -> Array:
    """Reflection points `(N, 3)` of `lamp (N, 3)` to `eye (3,)` on a mirror sphere; NaN if none.

    Alhazen's problem, by bisection in the plane of eye, lamp and centre.
    """
    a, b = eye - centre, lamp - centre
    ra, rb = np.linalg.norm(a), np.linalg.norm(b, axis=-1)
    x = a / ra
    across = b - (b @ x)[:, None] * x
    y = across / np.maximum(np.linalg.norm(across, axis=-1, keepdims=True), 1e-12)
    whole = np.arctan2(np.einsum("ni,ni->n", b, y), b @ x)
    low, high = np.zeros_like(whole), whole.copy()
    for _ in range(55):
        middle = 0.5 * (low + high)
        into = np.arctan2(ra * np.sin(middle), ra * np.cos(middle) - radius)
        rest = whole - middle
        out = np.arctan2(rb * np.sin(rest), rb * np.cos(rest) - radius)
        low, high = np.where(into < out, middle, low), np.where(into < out, high, middle)
    visible = into < np.pi / 2
    at = centre + radius * (np.cos(middle)[:, None] * x + np.sin(middle)[:, None] * y)
    return np.where(visible[:, None], at, np.nan)


def _glints(sphere: SphereProp, camera: Camera, lights: Sequence[Light]) -> Response:
    """Highlights: each lamp is a disc of points, whose flux is added to their pixels.

    A point of a lamp of area A has the radiance I / A; its image covers A times the mapping's
    determinant, in pixels per square metre.
    """
    rng = np.random.default_rng(5)
    points = 256
    image = np.zeros((len(lights), camera.height * camera.width, 3), np.float32)
    for film, light in zip(image, lights, strict=True):
        away = facing(sphere.centre - light.position)
        radius = light.radius if light.radius > 0 else LAMP_RADIUS
        angle = rng.uniform(0, 2 * np.pi, points)
        disc = radius * np.sqrt((np.arange(points) + 0.5) / points)
        across = disc[:, None] * (
            np.cos(angle)[:, None] * away[0] + np.sin(angle)[:, None] * away[1]
        )
        step = 1e-4
        probes = light.position + step * np.concatenate([away[:2], -away[:2]])
        lamp = np.concatenate([light.position + across, probes])
        hits = reflection(camera.center, lamp, sphere.centre, sphere.radius)
        if np.isnan(hits).any():
            continue  # at the very rim, or not at all
        at, _ = camera.project(hits)
        area = abs(np.linalg.det((at[points:][:2] - at[points:][2:]) / (2 * step)))
        flux = sphere.albedo * area * light.intensity_towards(sphere.centre) / points
        if camera.filter_sigma > 0:
            at = at + camera.filter_sigma * rng.standard_normal((len(at), 2))
        at = at[:points]
        inside = camera.inside(at)
        x, y = np.rint(at[inside]).astype(int).T
        np.add.at(film, y * camera.width + x, flux.astype(np.float32))
    pixels = np.flatnonzero(image.any(axis=(0, 2)))
    return Response(pixels, image[:, pixels])


def _form(towards: Array, normals: Array) -> Array:
    """Cosine over squared distance, 0 from behind."""
    squared = np.einsum("...i,...i", towards, towards)
    return np.maximum(np.einsum("...i,...i", towards, normals), 0) / squared**1.5


def _offsets(camera: Camera, n: int) -> Array:
    """`n` × `n` samples of a pixel: its box, or the camera's Gaussian."""
    share = (np.arange(n) + 0.5) / n
    one = share - 0.5
    if camera.filter_sigma > 0:
        one = camera.filter_sigma * np.sqrt(2) * erfinv(2 * share - 1)
    return np.stack(np.meshgrid(one, one), axis=-1).reshape(-1, 2)


def _rays(camera: Camera, offsets: Array, around: Array) -> tuple[Ints, Array]:
    """Flat pixels `(P,)` that contain the points `around (N, 3)`, and rays `(P, S, 3)`."""
    at, depth = camera.project(around)
    low, high = np.floor(at.min(axis=0)) - 2, np.ceil(at.max(axis=0)) + 3
    if not (depth > 0).all():
        low, high = np.zeros(2), np.array([camera.width, camera.height], float)
    x0, y0 = np.clip(low, 0, (camera.width, camera.height)).astype(int)
    x1, y1 = np.clip(high, 0, (camera.width, camera.height)).astype(int)
    y, x = np.mgrid[y0:y1, x0:x1]
    centres = np.stack([x.ravel(), y.ravel()], axis=-1)
    return centres[:, 1] * camera.width + centres[:, 0], camera.rays(centres[:, None] + offsets)


SPHERES = np.array([[0.0, 0, 0.02], [-0.06, 0.08, -0.05], [0.05, -0.09, -0.02], [0.02, 0.06, 0.08]])
"""Positions of a sphere, metres."""


def named_prop(name: str) -> Prop | None:
    """The prop called `board:N`, `mirror:N` or `diffuse:N`, N its pose or place; None: no prop."""
    kind, _, number = name.partition(":")
    if kind not in ("board", "mirror", "diffuse") or not number.isdigit():
        return None
    if kind == "board":
        return board_pose(int(number), Board())
    centre = SPHERES[int(number) % len(SPHERES)]
    return SphereProp(centre, 0.05, 0.9 if kind == "mirror" else 0.8, kind == "mirror")

"""Baseline images made of captured frames only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.ndimage import distance_transform_edt

from appearance.render.coverage import sees
from appearance.render.paths import Surface, camera_rays
from appearance.scene.hair_scene import SCALE, HairScene
from reconstruction import Camera, Capture, Light
from reconstruction.arrays import AnyFloats, Array, Bools, Ints

SATURATED = 1e-3  # weight of saturated values, decisive only if all are
CAMERAS = 3
"""Nearest cameras, and nearest lights, that are interpolated."""


def three_nearest(
    capture: Capture, camera: str, light: Light, training: Sequence[str]
) -> AnyFloats:
    """`camera`'s frames `(H, W, 3)` under the three `training` lights nearest to `light`, mixed.

    Weights are inverse angles about the head; each frame is scaled by the ratio of irradiances.
    `light` itself and dark lights are excluded, and saturated values or missing channels if others
    have them. Raises `ValueError` without such a frame.
    """
    names = other_lights(capture, camera, light, training)
    if not names:
        raise ValueError(f"{camera}: the capture has no frame of it under a light to mix from")
    others = [capture.rig.light(n) for n in names]
    positions = np.array([o.position for o in others])
    distance = np.linalg.norm(positions, axis=1)
    own = float(np.linalg.norm(light.position))
    nearest, weights = _nearest(positions, light.position, 3)
    total, known = np.zeros(1), np.zeros(1)
    for k, weight in zip(nearest, weights, strict=True):
        here, there = (x.intensity_towards(np.zeros(3)) for x in (light, others[k]))
        gain = here / np.where(there > 0, there, 1) * (distance[k] / own) ** 2
        frame, saturated = capture.light(names[k], camera)
        share = weight * np.where(saturated, SATURATED, 1.0)[..., None] * (there > 0)
        total, known = total + share * gain * frame, known + share
    return np.asarray(total / np.maximum(known, 1e-12))


def other_lights(capture: Capture, camera: str, light: Light, training: Sequence[str]) -> list[str]:
    """Those of `training`, without `light`, that reach the head and `camera` has a frame of."""
    return [
        n
        for n in training
        if n != light.name
        and capture.has_light(n, camera)
        and capture.rig.light(n).intensity_towards(np.zeros(3)).any()
    ]


@dataclass(frozen=True, eq=False)
class NearestCameras:
    """View interpolation: an image of `camera` from the frames of other cameras.

    Every pixel's point is the first hit of its ray with `scene`, or, for `mask (H, W)` without a
    hit, at the depth of the nearest pixel with one. Its colour is the mean, weighted by inverse
    angle about the head, of the `CAMERAS` nearest cameras of `training` in which it is visible, or,
    if in none, inside the image.
    """

    training: Capture
    camera: Camera
    pixels: Array
    weights: Array
    names: tuple[str, ...]

    @classmethod
    def of(
        cls, training: Capture, camera: Camera, scene: HairScene, mask: Bools
    ) -> NearestCameras | None:
        """Where each pixel lies in the nearest cameras; None where there is no other camera."""
        lights = training.olat_lights()
        others = [
            c
            for c in training.rig.cameras
            if c.name != camera.name and any(training.has_light(n, c.name) for n in lights)
        ]
        points, met = first_hits(scene, camera, mask)
        if not others or not met.any():
            return None
        nearest, by_angle = _nearest(np.array([c.center for c in others]), camera.center, CAMERAS)
        pixels = np.full((len(nearest), *met.shape, 2), -1.0)
        weights = np.zeros((len(nearest), *met.shape))
        fallback = np.zeros_like(weights)
        for k, (i, weight) in enumerate(zip(nearest, by_angle, strict=True)):
            where, depth = others[i].project(points[met])
            inside = (depth > 0) & others[i].inside(where)
            pixels[k][met] = where
            fallback[k][met] = weight * inside
            weights[k][met] = weight * (inside & sees(scene, others[i], points[met]))
        weights = np.where(weights.any(axis=0), weights, fallback)
        total = weights.sum(axis=0)
        weights = np.divide(weights, total, out=np.zeros_like(weights), where=total > 0)
        return cls(training, camera, pixels, weights, tuple(others[i].name for i in nearest))

    def __call__(self, light: Light) -> AnyFloats:
        """The frame `(H, W, 3)` under `light`.

        The other cameras' own frames under it where it is a training light, else what
        `three_nearest` makes of them.
        """
        training = self.training.olat_lights()
        total = np.zeros((self.camera.height, self.camera.width, 3))
        for name, where, weight in zip(self.names, self.pixels, self.weights, strict=True):
            if light.name in training and self.training.has_light(light.name, name):
                frame = self.training.light(light.name, name)[0]
            else:
                frame = three_nearest(self.training, name, light, training)
            x, y = np.moveaxis(where.astype(np.float32), -1, 0)
            found = cv2.remap(
                frame.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            )
            total += weight[..., None] * found
        return total


def _nearest(positions: Array, own: Array, most: int) -> tuple[Ints, Array]:
    """The `most` directions of `positions (N, 3)` nearest to `own (3,)`, and weights `(most,)`."""
    cosine = positions @ own / (np.linalg.norm(positions, axis=1) * np.linalg.norm(own))
    angle = np.arccos(np.clip(cosine, -1, 1))
    nearest = np.argsort(angle)[:most]
    weights = 1.0 / np.maximum(angle[nearest], 1e-6)
    return nearest, weights / weights.sum()


def first_hits(scene: HairScene, camera: Camera, mask: Bools) -> tuple[Array, Bools]:
    """Points `(H, W, 3)`, metres, that rays through the pixels' centres meet, and where `(H, W)`.

    Pixels of `mask` whose ray misses the hair take the depth of the nearest pixel that meets it.
    """
    row, column = np.indices((camera.height, camera.width)).reshape(2, -1)
    ray = camera_rays(camera, mi.Float(column + 0.5), mi.Float(row + 0.5))
    surface = Surface(scene)
    si = surface.interact(ray, mi.Bool(True))
    valid, shape = si.is_valid(), mask.shape
    found = valid, valid & surface.is_hair(si), dr.select(valid, si.t, 0)
    dr.eval(found)  # one tracing for the three
    met, hair, depth = (np.array(x).reshape(shape) for x in found)
    depth = depth.astype(float) / SCALE
    if hair.any():
        nearest = distance_transform_edt(~hair, return_distances=False, return_indices=True)
        depth = np.where(mask & ~hair, depth[tuple(nearest)], depth)
        met |= mask
    directions = camera.rays(np.stack([column, row], axis=-1)).reshape(*shape, 3)
    return camera.center + depth[..., None] * directions, met

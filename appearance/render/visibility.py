"""Which points of strands and head a light reaches: a shadow ray from each."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from appearance.scene.hair_scene import SCALE, HairScene
from reconstruction.array_backend import for_kernels
from reconstruction.arrays import Array, Bools, Ints

_OFF_SURFACE = 5e-5
"""Metres from the head's faces that rays begin: above float32's rounding of a metre."""


def reached(scene: HairScene, points: Array, towards: Array, offset: Array) -> Bools:
    """Whether the light at `towards (3,)` reaches each of `points (N, 3)`; all in metres.

    Rays begin at the points moved by `offset (N, 3)`. A ray that begins inside a fibre leaves it
    unhindered.
    """
    origin = ((points + offset) * SCALE).astype(np.float32)
    lanes: Any = mi.Point3f(*(mi.Float(for_kernels(np.ascontiguousarray(x))) for x in origin.T))
    target: Any = mi.Point3f(*(dr.opaque(mi.Float, float(x * SCALE)) for x in towards))
    away = target - lanes
    ray: Any = mi.Ray3f(lanes, away)
    ray.maxt = mi.Float(1)
    return ~np.array(scene.occluded(ray), bool)


def within_fibres(points: Array, towards: Array, radii: Array, seed: int) -> Array:
    """Offsets `(N, 3)` that spread rays from `points (N, 3)` over the width of fibres.

    Across the ray to `towards (3,)` and evenly over the section of radius `radii (N,)`: one ray a
    point, which is right in the mean over points.
    """
    ahead = towards - points
    ahead = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    rng = np.random.default_rng(seed)
    side = np.cross(ahead, rng.normal(size=points.shape))
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-12)
    return side * (0.95 * radii * rng.uniform(-1, 1, len(points)))[:, None]


def above_faces(vertices: Array, faces: Ints) -> Array:
    """Offsets `(V, 3)` that lift rays from a head's `vertices (V, 3)` off its `faces (F, 3)`."""
    corner = vertices[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    out = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(out, faces[:, k], normal)
    return _OFF_SURFACE * out / np.maximum(np.linalg.norm(out, axis=1, keepdims=True), 1e-18)

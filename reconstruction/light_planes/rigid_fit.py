"""Robust rigid motions by Gauss-Newton; undetermined directions stay at the start."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from reconstruction.arrays import Array
from reconstruction.geometry.cameras import Camera

Pose = tuple[Array, Array]
WEAKEST = 0.02
"""Share of the largest singular value below which a direction is undetermined."""

LEVER = 0.1  # metres: rotations are scaled to displacements at this distance


@dataclass(frozen=True, eq=False)
class Determination:
    """How well a solve determined its six directions of motion.

    `strength (6,)` are the singular values of its derivatives over the largest, ascending,
    `directions (6, 6)` their columns: a turn about the world's origin times `LEVER`, then a shift.
    """

    strength: Array
    directions: Array

    @property
    def rank(self) -> int:
        """How many directions are determined."""
        return int((self.strength > WEAKEST).sum())

    def named(self, count: int) -> list[str]:
        """Descriptions of the `count` weakest directions."""
        return [_in_words(d) for d in self.directions.T[:count]]

    @property
    def missing(self) -> list[str]:
        """Descriptions of the undetermined directions."""
        return self.named(6 - self.rank)


def _in_words(direction: Array) -> str:
    parts = []
    for what, part in (("turn about", direction[:3]), ("shift along", direction[3:])):
        size = float(np.linalg.norm(part))
        if size > 0.3:
            x, y, z = np.round(part / size, 1) + 0.0  # no minus zero
            parts.append(f"{what} ({x:g}, {y:g}, {z:g})")
    return " with ".join(parts)


def gauss_newton(
    system: Callable[[Pose], tuple[Array, Array]], iterations: int, start: Pose | None = None
) -> tuple[Pose, Determination]:
    """Minimise Huber's loss over rigid motions; undetermined directions do not change.

    `system(pose)` gives the residuals (M,) and their derivatives (M, 6) by a turn times `LEVER` and
    a shift, both applied after the pose.
    """
    rotation, translation = start if start is not None else (np.eye(3), np.zeros(3))
    found = Determination(np.zeros(6), np.eye(6))
    for _ in range(iterations):
        error, rows = system((rotation, translation))
        scale = 1.4826 * float(np.median(np.abs(error)))
        size = np.maximum(np.abs(error), np.finfo(float).tiny)
        weight = np.minimum(1.0, 1.345 * scale / size) if scale > 0 else np.ones_like(error)
        values, vectors = np.linalg.eigh(rows.T @ (rows * weight[:, None]))
        relative = np.maximum(values, 0) / max(float(values[-1]), np.finfo(float).tiny)
        found = Determination(np.sqrt(relative), vectors)
        strong = found.strength > WEAKEST
        basis = vectors[:, strong]
        step = -basis @ ((basis.T @ (rows.T @ (weight * error))) / values[strong])
        turn = Rotation.from_rotvec(step[:3] / LEVER).as_matrix()
        rotation, translation = turn @ rotation, turn @ translation + step[3:]
        if np.abs(step).max() < 1e-6:  # metres: a thousandth of a pixel
            break
    return (rotation, translation), found


def numeric(residual: Callable[[Pose], Array], pose: Pose) -> Array:
    """Derivatives `(M, 6)` of residuals by central differences."""
    columns = []
    for k in range(6):
        both = []
        for sign in (1.0, -1.0):
            step = np.zeros(6)
            step[k] = sign * 1e-5
            turn = Rotation.from_rotvec(step[:3] / LEVER).as_matrix()
            both.append(residual((turn @ pose[0], turn @ pose[1] + step[3:])))
        columns.append((both[0] - both[1]) / 2e-5)
    return np.stack(columns, axis=1)


def flow(gradient: Array, camera: Camera, points: Array, depth: Array) -> Array:
    """Derivative `(N, 6)` of an image of `gradient (N, 2)` at `points (N, 3)` by a rigid step."""
    local = points @ camera.R.T + camera.t
    z = np.where(depth > 0, depth, 1.0)
    x, y = local[:, 0] / z, local[:, 1] / z
    a = gradient[:, 0] * camera.K[0, 0]
    b = gradient[:, 0] * camera.K[0, 1] + gradient[:, 1] * camera.K[1, 1]
    by_point = np.stack([a / z, b / z, -(a * x + b * y) / z], axis=1) @ camera.R
    # d(w x p) . g = w . (p x g)
    return np.concatenate([np.cross(points, by_point) / LEVER, by_point], axis=1)

"""Rigid motions, and the one that aligns two sets of calibrated devices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from reconstruction.arrays import Array
from reconstruction.geometry.cameras import Pinhole

P = TypeVar("P", bound=Pinhole)


@dataclass(frozen=True, eq=False)
class Rigid:
    """x -> rotation @ x + translation."""

    rotation: Array
    translation: Array

    @classmethod
    def identity(cls) -> Self:
        """The identity."""
        return cls(np.eye(3), np.zeros(3))

    @classmethod
    def from_vector(cls, vector: ArrayLike) -> Self:
        """From a rotation vector and a translation `(6,)`."""
        v = np.asarray(vector, float)
        return cls(Rotation.from_rotvec(v[:3]).as_matrix(), v[3:])

    def vector(self) -> Array:
        """Rotation vector and translation `(6,)`."""
        turn = Rotation.from_matrix(self.rotation).as_rotvec()
        return np.concatenate([turn, self.translation])

    def inverse(self) -> Rigid:
        """The inverse motion."""
        return Rigid(self.rotation.T, -self.rotation.T @ self.translation)

    def __matmul__(self, first: Rigid) -> Rigid:
        return Rigid(self.rotation @ first.rotation, self(first.translation))

    def __call__(self, points: ArrayLike) -> Array:
        """Points `(..., 3)` moved."""
        return np.asarray(points, float) @ self.rotation.T + self.translation

    def in_frame(self, device: P) -> P:
        """`device` in the frame that this motion maps from."""
        return device.moved(self.rotation, self.translation)


def align_devices(found: Sequence[Pinhole], wanted: Sequence[Pinhole]) -> Rigid:
    """The rigid motion from the world of `found` to that of `wanted`, device for device.

    Kabsch 1976, on centres and points half a metre along the axes: one device suffices.
    """

    def points(devices: Sequence[Pinhole]) -> Array:
        return np.concatenate([[d.center, *(d.center + 0.5 * d.R)] for d in devices])

    a, b = points(found), points(wanted)
    turn, _ = Rotation.align_vectors(b - b.mean(axis=0), a - a.mean(axis=0))
    return Rigid(turn.as_matrix(), b.mean(axis=0) - turn.apply(a.mean(axis=0)))

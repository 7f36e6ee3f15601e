"""Pinhole cameras in OpenCV's convention."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def facing(forward: ArrayLike, roll_deg: float = 0.0) -> Array:
    """Rotation `(3, 3)` from the world to a device that looks along `forward (3,)`, not 0.

    Rows: right, down, forward. At roll 0 the device's up is the world's +z; `roll_deg` turns it
    clockwise about its viewing direction.
    """
    forward = np.asarray(forward, float)
    forward = forward / np.linalg.norm(forward)
    up = np.array([0.0, 0.0, 1.0]) if abs(forward[2]) < 0.999 else np.array([0.0, 1.0, 0.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    c, s = np.cos(np.radians(roll_deg)), np.sin(np.radians(roll_deg))
    return np.stack([c * right + s * down, c * down - s * right, forward])


@dataclass(frozen=True, eq=False)
class Pinhole:
    """A calibrated pinhole: `X_local = R @ X_world + t`, x right, y down, z forward.

    `K (3, 3)` is in pixels with the centre of the top-left pixel at (0, 0); `R (3, 3)` is a
    rotation; `t (3,)` is in metres. Cameras look through it, projectors shine through it.
    """

    name: str
    width: int
    height: int
    K: Array
    R: Array
    t: Array

    def __post_init__(self) -> None:
        for field, shape in (("K", (3, 3)), ("R", (3, 3)), ("t", (3,))):
            value = np.array(getattr(self, field), dtype=np.float64)
            if value.shape != shape or not np.isfinite(value).all():
                raise ValueError(
                    f"{self.name}: {field} must be {shape} finite numbers, got {value}"
                )
            object.__setattr__(self, field, value)
        if self.width < 1 or self.height < 1:
            raise ValueError(f"{self.name}: size must be positive, got {self.width}x{self.height}")
        if not np.allclose(self.R @ self.R.T, np.eye(3), atol=1e-6) or np.linalg.det(self.R) < 0:
            raise ValueError(f"{self.name}: R is not a rotation")
        if self.K[0, 0] <= 0 or self.K[1, 1] <= 0:
            raise ValueError(f"{self.name}: focal lengths must be positive, got {self.K}")

    @classmethod
    def look_at(
        cls,
        name: str,
        width: int,
        height: int,
        position: ArrayLike,
        target: ArrayLike,
        fov_deg: float,
        roll_deg: float = 0.0,
        **more: Any,
    ) -> Self:
        """Place a pinhole at `position (3,)` that looks at `target (3,)`.

        `fov_deg` is the horizontal field of view between the outer pixel edges. `roll_deg` turns
        the device clockwise about its viewing direction; at 0 its image's up is the world's +z.
        """
        position, target = np.asarray(position, float), np.asarray(target, float)
        if not np.linalg.norm(target - position) > 0:
            raise ValueError(f"{name}: position and target coincide at {position}")
        R = facing(target - position, roll_deg)
        f = 0.5 * width / np.tan(np.radians(fov_deg) / 2)
        K = np.array([[f, 0, (width - 1) / 2], [0, f, (height - 1) / 2], [0, 0, 1]])
        return cls(name, width, height, K, R, -R @ position, **more)

    @property
    def center(self) -> Array:
        """Centre of projection in the world `(3,)`, metres."""
        return -self.R.T @ self.t

    def project(self, points: ArrayLike) -> tuple[Array, Array]:
        """Project world `points (..., 3)` to pixels `(..., 2)` and depths along z `(...)`, metres.

        Points at or behind the pinhole (depth <= 0) get pixels that are not finite numbers' worth
        of anything: test the depth first.
        """
        local = np.asarray(points, float) @ self.R.T + self.t
        z = local[..., 2]
        xy = local[..., :2] / np.where(np.abs(z) < 1e-12, 1e-12, z)[..., None]
        pixels = np.stack(
            [
                self.K[0, 0] * xy[..., 0] + self.K[0, 1] * xy[..., 1] + self.K[0, 2],
                self.K[1, 1] * xy[..., 1] + self.K[1, 2],
            ],
            axis=-1,
        )
        return pixels, z

    def rays(self, pixels: ArrayLike) -> Array:
        """Unit world directions `(..., 3)` from the centre through `pixels (..., 2)`."""
        pixels = np.asarray(pixels, float)
        y = (pixels[..., 1] - self.K[1, 2]) / self.K[1, 1]
        x = (pixels[..., 0] - self.K[0, 2] - self.K[0, 1] * y) / self.K[0, 0]
        local = np.stack([x, y, np.ones_like(x)], axis=-1)
        world = local @ self.R
        return np.asarray(world / np.linalg.norm(world, axis=-1, keepdims=True))

    def inside(self, pixels: ArrayLike) -> NDArray[np.bool_]:
        """Whether `pixels (..., 2)` fall on the image, edge pixels' outer halves included."""
        p = np.asarray(pixels, float)
        return np.asarray(
            (p[..., 0] >= -0.5)
            & (p[..., 0] < self.width - 0.5)
            & (p[..., 1] >= -0.5)
            & (p[..., 1] < self.height - 0.5)
        )

    def moved(self, rotation: ArrayLike, translation: ArrayLike) -> Self:
        """The pinhole seen by a subject that moved by `x -> rotation @ x + translation`.

        Imaging the moved subject from here equals imaging the unmoved one from the result.
        """
        Q, d = np.asarray(rotation, float), np.asarray(translation, float)
        return replace(self, R=self.R @ Q, t=self.R @ d + self.t)

    def to_dict(self) -> dict[str, Any]:
        """A JSON-ready description that `from_dict` reads back exactly."""
        return {
            "name": self.name,
            "width": self.width,
            "height": self.height,
            "K": self.K.tolist(),
            "R": self.R.tolist(),
            "t": self.t.tolist(),
        }


@dataclass(frozen=True, eq=False)
class Camera(Pinhole):
    """A calibrated camera; see `Pinhole` for the convention."""

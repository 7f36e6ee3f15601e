"""The stage's lamps as point lights."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Light:
    """An isotropic point light at `position (3,)` in metres.

    `intensity (3,)` is the radiant intensity at full level, W/sr per linear RGB channel.
    `beside` names the camera that the lamp is mounted beside, if any.
    """

    name: str
    position: Array
    intensity: Array
    beside: str | None = None

    def __post_init__(self) -> None:
        for field in ("position", "intensity"):
            value = np.array(getattr(self, field), dtype=np.float64)
            if value.shape != (3,) or not np.isfinite(value).all():
                raise ValueError(f"{self.name}: {field} must be 3 finite numbers, got {value}")
            object.__setattr__(self, field, value)
        if (self.intensity < 0).any():
            raise ValueError(f"{self.name}: intensity must not be negative, got {self.intensity}")

    def moved(self, rotation: ArrayLike, translation: ArrayLike) -> Light:
        """The light seen by a subject that moved by `x -> rotation @ x + translation`."""
        Q, d = np.asarray(rotation, float), np.asarray(translation, float)
        return Light(self.name, Q.T @ (self.position - d), self.intensity, self.beside)

    def to_dict(self) -> dict[str, Any]:
        """A JSON-ready description that `Rig.from_dict` reads back exactly."""
        return {
            "name": self.name,
            "position": self.position.tolist(),
            "intensity": self.intensity.tolist(),
            "beside": self.beside,
        }


def dome_positions(count: int, radius: float, lowest_deg: float = -90.0) -> Array:
    """`count` nearly evenly spaced points `(count, 3)` on a sphere about the origin.

    A Fibonacci spiral from the zenith down to the elevation `lowest_deg`; `radius` in metres.
    """
    if count < 1 or radius <= 0 or not -90 <= lowest_deg < 90:
        raise ValueError(
            f"a dome needs count >= 1, radius > 0 and -90 <= lowest_deg < 90, "
            f"got {count}, {radius}, {lowest_deg}"
        )
    i = np.arange(count)
    z = 1 - (1 - np.sin(np.radians(lowest_deg))) * (i + 0.5) / count
    azimuth = i * np.pi * (3 - np.sqrt(5))
    r = np.sqrt(1 - z * z)
    return radius * np.stack([r * np.cos(azimuth), r * np.sin(azimuth), z], axis=1)

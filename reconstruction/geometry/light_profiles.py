"""How a light's intensity depends on direction: a table on the sphere."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike

from reconstruction.arrays import Array, Bools, Ints

Photometry = Literal["A", "B", "C"]
Unit = Literal["cd", "W/sr", "relative"]

POLAR_FRAMES: dict[str, Array] = {
    "C": np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, 1]]),
    "A": np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
    "B": np.array([[0.0, 0, 1], [0, -1, 0], [-1, 0, 0]]),
}
"""Rows: where longitude is 0 and 90 degrees on the equator, and the pole where colatitude is 0.

In the light's frame: x right, y down, z along its aim, as viewed from behind it. C: the pole is
the aim, longitudes run counter-clockwise from the right. A (headlamps): longitudes run about the
vertical axis from the aim to the right, and colatitude - 90 degrees is the elevation. B
(floodlights): longitudes run about the lateral axis from the aim upwards, and colatitude - 90
degrees is the angle to the right.
"""


@dataclass(frozen=True, eq=False)
class LightProfile:
    """Intensity over direction: `values (N, M)` at `longitude_deg (N,)` and `colatitude_deg (M,)`.

    Both angles ascend, longitudes over at most one turn; a full turn is periodic. Values are
    bilinear in the angles, 0 beyond the table. `photometry` places the poles (`POLAR_FRAMES`).
    `unit`: candela, W/sr, or a share of the peak ("relative"). Raises `ValueError` naming the
    profile and the field.
    """

    name: str
    longitude_deg: Array
    colatitude_deg: Array
    values: Array
    photometry: Photometry = "C"
    unit: Unit = "relative"

    def __post_init__(self) -> None:
        for field in ("longitude_deg", "colatitude_deg", "values"):
            object.__setattr__(self, field, np.array(getattr(self, field), dtype=np.float64))
        for field, least in (("longitude_deg", -180.0), ("colatitude_deg", 0.0)):
            angles = getattr(self, field)
            if angles.ndim != 1 or len(angles) < 2 or not (np.diff(angles) > 0).all():
                raise ValueError(f"profile {self.name}: {field} must ascend, 2 or more numbers")
            most = 180.0 if field == "colatitude_deg" else angles[0] + 360.0
            if angles[0] < least or angles[-1] > most:
                raise ValueError(
                    f"profile {self.name}: {field} must lie in [{least:g}, {most:g}], "
                    f"got {angles[0]:g} to {angles[-1]:g}"
                )
        shape = (len(self.longitude_deg), len(self.colatitude_deg))
        if self.values.shape != shape or not (np.isfinite(self.values) & (self.values >= 0)).all():
            raise ValueError(
                f"profile {self.name}: values must be {shape} finite numbers >= 0, "
                f"got shape {self.values.shape}"
            )
        if self.photometry not in POLAR_FRAMES or self.unit not in ("cd", "W/sr", "relative"):
            raise ValueError(
                f"profile {self.name}: photometry must be A, B or C and unit cd, W/sr or relative, "
                f"got {self.photometry!r} and {self.unit!r}"
            )

    def relative(self) -> Self:
        """The same shape with a peak of 1; `ValueError` for a profile that is dark everywhere."""
        peak = self.values.max()
        if not peak > 0:
            raise ValueError(f"profile {self.name}: it is dark everywhere, so it has no shape")
        return replace(self, values=self.values / peak, unit="relative")

    def at(self, directions: ArrayLike) -> Array:
        """Values `(...)` towards `directions (..., 3)` of any length in the light's frame."""
        longitude, colatitude = self.angles_deg(directions)
        i, a, lit_i = _interval(self.longitude_deg, longitude)
        j, b, lit_j = _interval(self.colatitude_deg, colatitude)
        v = self.values
        low = (1 - b) * v[i, j] + b * v[i, j + 1]
        high = (1 - b) * v[i + 1, j] + b * v[i + 1, j + 1]
        return np.where(lit_i & lit_j, (1 - a) * low + a * high, 0.0)

    def angles_deg(self, directions: ArrayLike) -> tuple[Array, Array]:
        """Longitudes, in the turn that starts at the first node, and colatitudes, `(...)` each."""
        polar = np.asarray(directions, float) @ POLAR_FRAMES[self.photometry].T
        colatitude = np.degrees(np.arctan2(np.hypot(polar[..., 0], polar[..., 1]), polar[..., 2]))
        turn = np.degrees(np.arctan2(polar[..., 1], polar[..., 0])) - self.longitude_deg[0]
        # a table centred on 0 degrees wraps half a turn from its middle
        spare = 0.5 * (360.0 - (self.longitude_deg[-1] - self.longitude_deg[0]))
        return (turn + spare) % 360.0 - spare + self.longitude_deg[0], colatitude

    @property
    def flux(self) -> float:
        """Integral of `at` over the sphere: lumens of candela, watts of W/sr. Exact, no sum."""
        step = np.radians(np.diff(self.longitude_deg))
        across = 0.5 * (np.append(step, 0) + np.append(0, step))
        c = np.radians(self.colatitude_deg)
        mean = np.diff(np.sin(c)) / np.diff(c)
        along = np.append(np.cos(c[:-1]) - mean, 0) + np.append(0, mean - np.cos(c[1:]))
        return float(across @ self.values @ along)

    def to_dict(self) -> dict[str, Any]:
        """A JSON-ready description: `LightProfile(**it)` is the same again."""
        return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in vars(self).items()}


@lru_cache
def cosine_lobe(power: float) -> LightProfile:
    """cos^power of the angle to the aim, 0 behind: an LED; 1 is a Lambertian emitter.

    Linear between steps of 0.5 degrees. Raises `ValueError` for a power outside [0, 1000].
    """
    if not 0 <= power <= 1000:
        raise ValueError(f"the power of a cosine lobe must lie in [0, 1000], got {power}")
    angle = np.linspace(0, 90, 181)
    values = np.cos(np.radians(angle)).clip(0) ** power
    return LightProfile(f"cosine_{power:g}", np.array([0, 360]), angle, np.stack([values, values]))


_SLACK_DEG = 1e-9  # keeps a direction on the last node inside despite rounding


def _interval(nodes: Array, x: Array) -> tuple[Ints, Array, Bools]:
    """Left node of the interval that holds `x`, the share of the way through it, and if it does."""
    i = np.clip(np.searchsorted(nodes, x, side="right") - 1, 0, len(nodes) - 2)
    share = (x - nodes[i]) / (nodes[i + 1] - nodes[i])
    inside = (x >= nodes[0] - _SLACK_DEG) & (x <= nodes[-1] + _SLACK_DEG)
    return i, np.clip(share, 0.0, 1.0), inside

"""The stage's lights: points, small spheres, rectangles, with or without a profile; patterns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from reconstruction.arrays import AnyFloats, Array
from reconstruction.geometry.light_profiles import LightProfile


@dataclass(frozen=True, eq=False)
class Light:
    """A light at `position (3,)` in metres, an isotropic point by default.

    `intensity (3,)` is the radiant intensity at full level, W/sr per linear RGB channel; with a
    `profile` it is multiplied by the profile's value: W/sr where that is relative to its peak, a
    dimensionless colour where it is in W/sr, W/sr per candela where it is in candela.
    `beside` names the camera that the light is mounted beside, if any.

    `orientation (3, 3)` turns the world into the light's frame, as for cameras: rows right, down,
    forward, the light's aim. `radius` in metres makes it a sphere that is equally bright all over,
    `size (2,)` (width, height) a rectangle across its aim that shines forward only, with the
    intensity a cosine of the angle to the aim unless a profile says otherwise.
    """

    name: str
    position: Array
    intensity: Array
    beside: str | None = None
    orientation: Array | None = None
    profile: LightProfile | None = None
    radius: float = 0.0
    size: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        for field in ("position", "intensity"):
            value = np.array(getattr(self, field), dtype=np.float64)
            if value.shape != (3,) or not np.isfinite(value).all():
                raise ValueError(f"{self.name}: {field} must be 3 finite numbers, got {value}")
            object.__setattr__(self, field, value)
        if (self.intensity < 0).any():
            raise ValueError(f"{self.name}: intensity must not be negative, got {self.intensity}")
        if not 0 <= self.radius < np.inf:
            raise ValueError(f"{self.name}: radius must be 0 or more, got {self.radius}")
        if self.size is not None:
            size = (float(self.size[0]), float(self.size[1]))
            if len(self.size) != 2 or not all(0 < s < np.inf for s in size) or self.radius > 0:
                raise ValueError(
                    f"{self.name}: size must be 2 positive numbers, without a radius, "
                    f"got {self.size} and radius {self.radius}"
                )
            object.__setattr__(self, "size", size)
        if self.orientation is not None:
            R = np.array(self.orientation, dtype=np.float64)
            turns = R.shape == (3, 3) and np.allclose(R @ R.T, np.eye(3), atol=1e-6)
            if not turns or np.linalg.det(R) < 0:
                raise ValueError(
                    f"{self.name}: orientation must be a rotation (3, 3), no mirror, got {R}"
                )
            object.__setattr__(self, "orientation", R)
        elif self.profile is not None or self.size is not None:
            raise ValueError(f"{self.name}: a light with a profile or a size needs an aim")

    def intensity_towards(self, points: ArrayLike) -> Array:
        """Radiant intensity `(..., 3)`, W/sr, from the centre towards world `points (..., 3)`."""
        away = np.asarray(points, float) - self.position
        share: Any = 1.0
        if self.orientation is not None:
            local = away @ self.orientation.T
            if self.profile is not None:
                share = self.profile.at(local)
            if self.size is not None:
                cosine = local[..., 2] / np.linalg.norm(local, axis=-1)
                share = share * (cosine > 0) if self.profile is not None else cosine.clip(0)
        return self.intensity * np.broadcast_to(share, away.shape[:-1])[..., None]

    def irradiance(self, points: ArrayLike) -> Array:
        """Irradiance `(..., 3)`, W/m², across the ray to world `points (..., 3)`, unshadowed."""
        squared = np.square(np.asarray(points, float) - self.position).sum(axis=-1)
        return self.intensity_towards(points) / np.maximum(squared, 1e-12)[..., None]

    def scaled(self, factor: float) -> Light:
        """The light at `factor` times its intensity."""
        return replace(self, intensity=self.intensity * factor)

    def moved(self, rotation: ArrayLike, translation: ArrayLike) -> Light:
        """The light as a subject moved by `x -> rotation (3, 3) @ x + translation (3,)` has it."""
        Q, d = np.asarray(rotation, float), np.asarray(translation, float)
        turned = None if self.orientation is None else self.orientation @ Q
        return replace(self, position=Q.T @ (self.position - d), orientation=turned)

    def to_dict(self) -> dict[str, Any]:
        """A JSON-ready description; the profile is only named, the rig's description holds it."""
        out: dict[str, Any] = {"name": self.name, "position": self.position.tolist()}
        out |= {"intensity": self.intensity.tolist(), "beside": self.beside}
        if self.orientation is not None:
            out["orientation"] = self.orientation.tolist()
        if self.profile is not None:
            out["profile"] = self.profile.name
        if self.radius > 0:
            out["radius"] = self.radius
        if self.size is not None:
            out["size"] = list(self.size)
        return out


@dataclass(frozen=True, eq=False)
class LightPattern:
    """Lights that shine together: `weights (K,)` are factors on the intensities of `lights`."""

    name: str
    lights: tuple[Light, ...]
    weights: Array

    @property
    def position(self) -> Array:
        """Mean position `(3,)` of the lights by weight and brightness, which gives a direction."""
        strength = self.weights * [x.intensity.mean() for x in self.lights]
        mean = strength @ [x.position for x in self.lights]
        return np.asarray(mean / max(strength.sum(), np.finfo(float).tiny))

    def irradiance(self, points: ArrayLike) -> Array:
        """The sum of the lights' `irradiance (..., 3)` at world `points (..., 3)`."""
        each = (w * x.irradiance(points) for w, x in zip(self.weights, self.lights, strict=True))
        return np.asarray(sum(each))

    def scaled(self, factor: float) -> LightPattern:
        """The pattern at `factor` times its intensity."""
        return replace(self, weights=factor * self.weights)


Lighting = Light | LightPattern
"""What lights a frame."""


def components(lightings: Sequence[Lighting]) -> tuple[list[Light], Array | None]:
    """The distinct lights (L) of `lightings` (M), and the matrix `(M, L)` whose product with their
    pictures is that under each lighting; None where each is a light of its own."""
    lights = {
        y.name: y for x in lightings for y in (x.lights if isinstance(x, LightPattern) else (x,))
    }
    if not any(isinstance(x, LightPattern) for x in lightings):
        return [x for x in lightings if isinstance(x, Light)], None
    at = {name: i for i, name in enumerate(lights)}
    mix = np.zeros((len(lightings), len(lights)))
    for row, x in zip(mix, lightings, strict=True):
        if isinstance(x, LightPattern):
            row[[at[y.name] for y in x.lights]] = x.weights
        else:
            row[at[x.name]] = 1.0
    return list(lights.values()), mix


def mixed(mix: Array | None, pictures: AnyFloats, axis: int = 0) -> Any:
    """The sums `mix (M, L)` of `pictures (…, L, …)` along `axis`; None: as they are."""
    if mix is None:
        return pictures
    sums = np.tensordot(mix.astype(pictures.dtype), pictures, (1, axis))
    return np.moveaxis(sums, 0, axis)


def dome_positions(count: int, radius: float, lowest_deg: float = -90.0) -> Array:
    """`count` nearly evenly spaced points `(N, 3)` on a sphere about the origin.

    A Fibonacci spiral from the zenith down to the elevation `lowest_deg`; `radius` in metres.
    """
    if count < 1 or not 0 < radius < np.inf or not -90 <= lowest_deg < 90:
        raise ValueError(
            f"a dome needs count >= 1, radius > 0 and -90 <= lowest_deg < 90, "
            f"got {count}, {radius}, {lowest_deg}"
        )
    i = np.arange(count)
    z = 1 - (1 - np.sin(np.radians(lowest_deg))) * (i + 0.5) / count
    azimuth = i * np.pi * (3 - np.sqrt(5))
    r = np.sqrt(1 - z * z)
    return radius * np.stack([r * np.cos(azimuth), r * np.sin(azimuth), z], axis=1)

"""Kajiya and Kay's reflectance, the guide of an interpolation of frames."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from reconstruction.arrays import Floats


@dataclass(frozen=True)
class KajiyaKay:
    """K(t, h) cos θ with K = |sin(t, h)|^α + ρ_d (Photobooth, Eq. 4; ρ_s = 1, L = 1).

    `diffuse` is ρ_d, `exponent` α. Raises `ValueError` for negative or infinite ones.
    """

    diffuse: float
    exponent: float

    def __post_init__(self) -> None:
        for name in ("diffuse", "exponent"):
            value = getattr(self, name)
            if not 0 <= value < np.inf:
                raise ValueError(f"Kajiya-Kay: {name} must be 0 or more, got {value}")

    def __call__(self, tangent: Floats, towards_camera: Floats, towards_light: Floats) -> Floats:
        """K(t, h) cos θ `(...)` of unit directions `(..., 3)`, which broadcast.

        h is the half vector, θ the angle between the light and the plane across the hair.
        """
        along_light = _dot(tangent, towards_light)
        h = towards_camera + towards_light
        squared = np.maximum(_dot(h, h), np.float32(1e-12))  # 0 for opposite light and camera
        sine_squared = np.clip(1 - _dot(tangent, h) ** 2 / squared, 0, 1)
        specular = sine_squared ** np.float32(0.5 * self.exponent)
        cosine = np.sqrt(np.clip(1 - along_light**2, 0, 1))
        return np.asarray((specular + np.float32(self.diffuse)) * cosine, np.float32)

    @cached_property
    def mean(self) -> float:
        """About its mean over all directions of camera and light."""
        rng = np.random.default_rng(0)
        camera, light = rng.normal(size=(2, 1 << 13, 3)).astype(np.float32)
        camera, light = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (camera, light))
        return float(self(np.eye(3, dtype=np.float32)[2:], camera, light).mean())


def _dot(a: Floats, b: Floats) -> Floats:
    return np.asarray(np.einsum("...i,...i->...", a, b))

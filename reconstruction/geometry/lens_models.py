"""Lenses that `Camera` does not model: rational, thin-prism, tilted, fisheye, Metashape's own.

Their images are resampled once, on import: `Lens.of` takes such a camera too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import numpy as np

from reconstruction.arrays import Array
from reconstruction.geometry.cameras import Camera

Kind = Literal["opencv", "fisheye", "metashape"]
COUNTS: dict[Kind, int] = {"opencv": 14, "fisheye": 4, "metashape": 8}
WIDEST = 5.0  # x/z: beyond 79 degrees off the axis no pinhole image is usable
_STEPS = 30


@dataclass(frozen=True, eq=False)
class LensModel:
    """How a lens distorts normalised coordinates x/z, y/z; missing coefficients are 0.

    `opencv`: k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, τx, τy of OpenCV's pinhole model
    (docs.opencv.org, calib3d). `fisheye`: k1, k2, k3, k4 of its fisheye model, after Kannala and
    Brandt 2006. `metashape`: k1, k2, k3, k4, p1, p2, p3, p4 of a frame camera (Metashape manual,
    "Camera models"), where p1 and p2 are OpenCV's p2 and p1.
    """

    kind: Kind
    coefficients: Array

    def __post_init__(self) -> None:
        given = np.array(self.coefficients, dtype=np.float64).ravel()
        count = COUNTS[self.kind]
        if len(given) > count or not np.isfinite(given).all():
            raise ValueError(f"a {self.kind} lens has up to {count} coefficients, got {given}")
        object.__setattr__(self, "coefficients", np.append(given, np.zeros(count - len(given))))

    def bend(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Distorted coordinates `(...)` from undistorted ones."""
        return _MODELS[self.kind](self.coefficients, x, y)

    def straighten(self, a: Array, b: Array) -> tuple[Array, Array]:
        """Undistorted coordinates `(...)` from distorted ones, by Newton's method; NaN where that
        does not converge."""
        x, y, h = np.array(a, float), np.array(b, float), 1e-6
        for _ in range(_STEPS):
            u, v = self.bend(x, y)
            ux, vx = ((p - q) / (2 * h) for p, q in self._pairs((x + h, y), (x - h, y)))
            uy, vy = ((p - q) / (2 * h) for p, q in self._pairs((x, y + h), (x, y - h)))
            scale = 1 / (ux * vy - uy * vx)
            dx, dy = (vy * (a - u) - uy * (b - v)) * scale, (ux * (b - v) - vx * (a - u)) * scale
            longest = np.maximum(np.hypot(dx, dy), 1e-300)
            short = np.minimum(1, 0.5 * (1 + np.hypot(x, y)) / longest)
            x, y = x + short * dx, y + short * dy
        u, v = self.bend(x, y)
        wrong = ~(np.hypot(u - a, v - b) < 1e-9 * (1 + np.hypot(a, b)))
        return np.where(wrong, np.nan, x), np.where(wrong, np.nan, y)

    def _pairs(
        self, up: tuple[Array, Array], down: tuple[Array, Array]
    ) -> Iterator[tuple[Array, Array]]:
        return zip(self.bend(*up), self.bend(*down), strict=True)


def _opencv(k: Array, x: Array, y: Array) -> tuple[Array, Array]:
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, tx, ty = k
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    a = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + r2 * (s1 + s2 * r2)
    b = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + r2 * (s3 + s4 * r2)
    if not (tx or ty):
        return a, b
    cx, sx, cy, sy = np.cos(tx), np.sin(tx), np.cos(ty), np.sin(ty)
    R = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]]) @ np.array(
        [[1, 0, 0], [0, cx, sx], [0, -sx, cx]]
    )
    tilt = np.array([[R[2, 2], 0, -R[0, 2]], [0, R[2, 2], -R[1, 2]], [0, 0, 1]]) @ R
    p, q, w = (row[0] * a + row[1] * b + row[2] for row in tilt)
    return p / w, q / w


def _fisheye(k: Array, x: Array, y: Array) -> tuple[Array, Array]:
    r = np.hypot(x, y)
    angle = np.arctan(r)
    t2 = angle * angle
    bent = angle * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))))
    scale = np.where(r > 1e-12, bent / np.maximum(r, 1e-12), 1.0)
    return x * scale, y * scale


def _metashape(k: Array, x: Array, y: Array) -> tuple[Array, Array]:
    k1, k2, k3, k4, p1, p2, p3, p4 = k
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    more = 1 + r2 * (p3 + r2 * p4)
    a = x * radial + (p1 * (r2 + 2 * x * x) + 2 * p2 * x * y) * more
    b = y * radial + (p2 * (r2 + 2 * y * y) + 2 * p1 * x * y) * more
    return a, b


_MODELS: dict[Kind, Callable[[Array, Array, Array], tuple[Array, Array]]] = {
    **{"opencv": _opencv, "fisheye": _fisheye, "metashape": _metashape}
}


@dataclass(frozen=True, eq=False)
class LensModelCamera(Camera):
    """A camera whose images must be resampled to `Lens.of(camera).undistorted`.

    Raises `ValueError` where its lens cannot be inverted over the image or is wider than a pinhole.
    """

    lens: LensModel = field(default_factory=lambda: LensModel("opencv", np.zeros(0)))

    @property
    def distorted(self) -> bool:
        """Whether the lens bends lines: here always."""
        return True

    def pinhole(self) -> Camera:
        """The same camera without its lens."""
        return Camera(self.name, self.width, self.height, self.K, self.R, self.t)

    def to_dict(self) -> dict[str, Any]:
        """Raises `ValueError`: no rig file holds such a lens."""
        raise ValueError(f"{self.name}: a {self.lens.kind} lens is resampled, not kept")

    def _through_lens(self, x: Array, y: Array) -> tuple[Array, Array]:
        far = np.maximum(np.hypot(x, y) / self._reach, 1.0)
        a, b = self.lens.bend(x / far, y / far)
        return a * far, b * far

    def _before_lens(self, x: Array, y: Array) -> tuple[Array, Array]:
        return self.lens.straighten(x, y)

    @cached_property
    def _reach(self) -> float:
        u, v = self.lens.straighten(*self._border())
        return 1.1 * float(np.hypot(u, v).max())

    def _check_lens(self) -> None:
        with np.errstate(all="ignore"):
            reach = self._reach
        if not reach < WIDEST:  # NaN too
            raise ValueError(
                f"{self.name}: its {self.lens.kind} lens with {self.lens.coefficients.tolist()} "
                "cannot be inverted over the image, or covers more than 79 degrees off the axis: "
                "crop and undistort its images before the import"
            )

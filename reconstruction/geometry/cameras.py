"""Cameras and pinholes in OpenCV's convention."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from reconstruction.arrays import Array, Bools, Ints


def facing(forward: ArrayLike, roll_deg: float = 0.0) -> Array:
    """Rotation `(3, 3)` from the world to a device that looks along `forward (3,)`, not 0.

    Rows: right, down, forward. At roll 0 the device's up is the world's +z; `roll_deg` turns it
    clockwise about its viewing direction.
    """
    ahead: Array = np.asarray(forward, float)
    ahead = ahead / np.linalg.norm(ahead)
    up = np.array([0.0, 0.0, 1.0]) if abs(ahead[2]) < 0.999 else np.array([0.0, 1.0, 0.0])
    right = np.cross(ahead, up)
    right /= np.linalg.norm(right)
    down = np.cross(ahead, right)
    c, s = np.cos(np.radians(roll_deg)), np.sin(np.radians(roll_deg))
    return np.stack([c * right + s * down, c * down - s * right, ahead])


@dataclass(frozen=True, eq=False)
class Pinhole:
    """A calibrated pinhole: `X_local = R @ X_world + t`, x right, y down, z forward.

    `K (3, 3)` is in pixels with the centre of the top-left pixel at (0, 0); `R (3, 3)` is a
    rotation; `t (3,)` is in metres.
    """

    name: str
    width: int
    height: int
    K: Array
    R: Array
    t: Array

    def __post_init__(self) -> None:
        for name, shape in (("K", (3, 3)), ("R", (3, 3)), ("t", (3,))):
            value = np.array(getattr(self, name), dtype=np.float64)
            if value.shape != shape or not np.isfinite(value).all():
                raise ValueError(f"{self.name}: {name} must be {shape} finite numbers, got {value}")
            object.__setattr__(self, name, value)
        if self.width < 1 or self.height < 1:
            raise ValueError(f"{self.name}: size must be positive, got {self.width}x{self.height}")
        if not np.allclose(self.R @ self.R.T, np.eye(3), atol=1e-6) or np.linalg.det(self.R) < 0:
            raise ValueError(f"{self.name}: R is not a rotation")
        if self.K[1, 0] or self.K[2, :2].any() or self.K[2, 2] != 1:
            raise ValueError(
                f"{self.name}: K must be [[fx, skew, cx], [0, fy, cy], [0, 0, 1]], got "
                f"{self.K.tolist()}: is it transposed, as MATLAB's is, or scaled?"
            )
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

        Pixels of points at or behind the pinhole (depth <= 0) have no meaning.
        """
        local = np.asarray(points, float) @ self.R.T + self.t
        z = local[..., 2]
        xy = local[..., :2] / np.where(np.abs(z) < 1e-12, 1e-12, z)[..., None]
        x, y = self._through_lens(xy[..., 0], xy[..., 1])
        u, v = self.K[0, 0] * x + self.K[0, 1] * y + self.K[0, 2], self.K[1, 1] * y + self.K[1, 2]
        return np.stack([u, v], axis=-1), z

    def rays(self, pixels: ArrayLike) -> Array:
        """Unit world directions `(..., 3)` from the centre through `pixels (..., 2)`."""
        x, y = self._normalised(np.asarray(pixels, float))
        local = np.stack([x, y, np.ones_like(x)], axis=-1)
        world = local @ self.R
        return np.asarray(world / np.linalg.norm(world, axis=-1, keepdims=True))

    def _normalised(self, pixels: Array) -> tuple[Array, Array]:
        """Undistorted normalised coordinates x/z, y/z `(...)` of `pixels (..., 2)`."""
        y = (pixels[..., 1] - self.K[1, 2]) / self.K[1, 1]
        x = (pixels[..., 0] - self.K[0, 2] - self.K[0, 1] * y) / self.K[0, 0]
        return self._before_lens(x, y)

    def _through_lens(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Distorted normalised coordinates x/z, y/z from undistorted ones."""
        return x, y

    def _before_lens(self, x: Array, y: Array) -> tuple[Array, Array]:
        """The inverse of `_through_lens`."""
        return x, y

    def inside(self, pixels: ArrayLike) -> Bools:
        """Whether `pixels (..., 2)` fall on the image, edge pixels' outer halves included."""
        p = np.asarray(pixels, float)
        end = np.array([self.width - 0.5, self.height - 0.5])
        return np.asarray(((p >= -0.5) & (p < end)).all(axis=-1))

    def pixels_of(self, points: ArrayLike) -> tuple[Bools, Ints, Ints, Array]:
        """Which of `points (N, 3)` fall on the image, the pixels' x and y, and depths; `(N,)` each.

        x and y are 0 where a point falls on no pixel; depths are metres along z.
        """
        pixels, depth = self.project(points)
        visible = (depth > 0) & self.inside(pixels)
        x, y = np.rint(np.where(visible[:, None], pixels, 0)).astype(int).T
        return visible, x, y, depth

    def moved(self, rotation: ArrayLike, translation: ArrayLike) -> Self:
        """The pinhole from which the unmoved subject looks as the moved one does from here.

        The subject moves by `x -> rotation (3, 3) @ x + translation (3,)`.
        """
        Q, d = np.asarray(rotation, float), np.asarray(translation, float)
        return replace(self, R=self.R @ Q, t=self.R @ d + self.t)

    def to_dict(self) -> dict[str, Any]:
        """A JSON-ready description that `from_dict` reads back exactly."""
        size = {"name": self.name, "width": self.width, "height": self.height}
        return size | {k: getattr(self, k).tolist() for k in ("K", "R", "t")}


@dataclass(frozen=True, eq=False)
class Camera(Pinhole):
    """A calibrated camera with its lens; see `Pinhole` for the convention.

    `distortion` holds OpenCV's k1, k2, p1, p2, k3 (shorter lists end in zeros). Beyond 1.1 times
    the image's radius the factor stays constant, so that the polynomial folds nothing back into
    the image. `filter_sigma` is the standard deviation in pixels of a pixel's Gaussian filter; 0
    is a box of one pixel. Raises `ValueError` where the lens is not invertible over the image.
    """

    distortion: Array = field(default_factory=lambda: np.zeros(5))
    filter_sigma: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        given = np.array(self.distortion, dtype=np.float64).ravel()
        if len(given) > 5 or not np.isfinite(given).all():
            raise ValueError(
                f"{self.name}: distortion must be up to 5 numbers k1, k2, p1, p2, k3, got {given}"
            )
        object.__setattr__(self, "distortion", np.append(given, np.zeros(5 - len(given))))
        if not 0 <= self.filter_sigma < np.inf:
            raise ValueError(f"{self.name}: filter_sigma must be >= 0, got {self.filter_sigma}")
        if self.distorted:
            self._check_lens()

    @property
    def distorted(self) -> bool:
        """Whether the lens bends lines."""
        return bool(self.distortion.any())

    def pinhole(self) -> Camera:
        """The same camera without its lens."""
        return replace(self, distortion=np.zeros(5))

    def reduced(self, by: int) -> Camera:
        """The camera of images reduced by `block_means`; `ValueError` where no pixel is left."""
        if by == 1:
            return self
        if by < 1 or min(self.width, self.height) < by:
            raise ValueError(
                f"{self.name}: images of {self.width}x{self.height} pixels cannot be reduced by "
                f"{by}"
            )
        K = self.K.copy()
        K[:2] /= by
        K[:2, 2] += 0.5 / by - 0.5
        sigma = self.filter_sigma and np.sqrt(self.filter_sigma**2 + (by * by - 1) / 12) / by
        width, height = self.width // by, self.height // by
        return replace(self, width=width, height=height, K=K, filter_sigma=float(sigma))

    def to_dict(self) -> dict[str, Any]:
        """A JSON-ready description that `Rig.from_dict` reads back exactly."""
        out = super().to_dict()
        if self.distorted:
            out["distortion"] = self.distortion.tolist()
        if self.filter_sigma > 0:
            out["filter_sigma"] = self.filter_sigma
        return out

    def _through_lens(self, x: Array, y: Array) -> tuple[Array, Array]:
        if not self.distorted:
            return x, y
        far = np.maximum(np.hypot(x, y) / self._reach, 1.0)
        a, b, _ = _bent(self.distortion, x / far, y / far)
        return a * far, b * far

    def _before_lens(self, x: Array, y: Array) -> tuple[Array, Array]:
        return undistorted(self.distortion, x, y) if self.distorted else (x, y)

    @cached_property
    def _reach(self) -> float:
        """Radius before the lens of the image's furthest corner, and a tenth more."""
        u, v = undistorted(self.distortion, *self._border())
        return 1.1 * float(np.hypot(u, v).max())

    def _border(self) -> tuple[Array, Array]:
        """Distorted normalised coordinates `(17, 17)` all over the image, its edges included."""
        column, row = np.meshgrid(
            np.linspace(-0.5, self.width - 0.5, 17), np.linspace(-0.5, self.height - 0.5, 17)
        )
        y = (row - self.K[1, 2]) / self.K[1, 1]
        x = (column - self.K[0, 2] - self.K[0, 1] * y) / self.K[0, 0]
        return x, y

    def _check_lens(self) -> None:
        with np.errstate(all="ignore"):  # a lens that cannot be inverted overflows here
            x, y = self._border()
            u, v = undistorted(self.distortion, x, y)
            a, b, (axx, axy, ayy) = _bent(self.distortion, u, v)
            upright = (axx > 0) & (ayy > 0) & (axx * ayy > axy * axy)
            same = np.hypot(a - x, b - y) < 1e-9
            radius = np.hypot(u, v).max() * np.linspace(0, 1.1, 45)
            zero = np.zeros_like(radius)
            outwards = _bent(self.distortion * (1, 1, 0, 0, 1), radius, zero)[2][0] > 0
            good = bool(upright.all() and same.all() and outwards.all())
        if not good:
            raise ValueError(
                f"{self.name}: the lens folds over within the image with distortion "
                f"{self.distortion.tolist()}: it cannot be inverted"
            )


_NEWTON_STEPS = 8


def undistorted(distortion: Iterable[Any], x: Any, y: Any) -> tuple[Any, Any]:
    """Undistorted normalised coordinates from distorted ones, by Newton's method.

    Works on NumPy's and Dr.Jit's arrays; see `Camera.distortion`.
    """
    u, v = x, y
    for _ in range(_NEWTON_STEPS):
        a, b, (axx, axy, ayy) = _bent(distortion, u, v)
        a, b = x - a, y - b
        scale = 1 / (axx * ayy - axy * axy)
        u, v = u + (ayy * a - axy * b) * scale, v + (axx * b - axy * a) * scale
    return u, v


def _bent(k: Iterable[Any], x: Any, y: Any) -> tuple[Any, Any, tuple[Any, Any, Any]]:
    """Distorted coordinates, and their (symmetric) derivative: d/dx x, d/dy x, d/dy y."""
    k1, k2, p1, p2, k3 = k
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    gradient = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))
    a = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    b = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    axx = radial + gradient * x * x + 2 * p1 * y + 6 * p2 * x
    axy = gradient * x * y + 2 * p1 * x + 2 * p2 * y
    ayy = radial + gradient * y * y + 6 * p1 * y + 2 * p2 * x
    return a, b, (axx, axy, ayy)

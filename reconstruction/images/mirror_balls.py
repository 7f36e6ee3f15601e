"""Directions and positions of lights by their highlights on mirror balls.

A ball's outline is a cone of rays around the ray to its centre; at the highlight a ray r leaves as
r − 2 (r·n) n. An error of δ pixels in a ball of R pixels is one of 2δ / (R cos θ) in the direction,
θ between normal and ray. Balls or cameras apart give distances.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.optimize import least_squares

from reconstruction.arrays import AnyFloats, Array, Bools
from reconstruction.capture.grey_ball import Circle, GreyBall, PlacedBall
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.lights import Light

PIXEL = 0.4
"""Assumed error of a highlight relative to its ball's outline, pixels."""
SAME_SIZE = 0.15
"""Relative difference of a ball's radius between cameras."""
INNER, GRAZING = 0.97, 0.2
"""Radii up to which highlights are sought; least cosine between normal and ray."""
SPOT, SPOT_PIXELS = 0.08, 12
"""Share of the disc, and pixels, above half of the peak up to which it is a highlight: a matt ball
is bright over a quarter of its disc."""
SECOND = 0.5
"""Share of the brightest spot's light from which another one makes it ambiguous."""
DETERMINED = 0.15
"""Relative standard error up to which a light's distance is determined."""


@dataclass(frozen=True, eq=False)
class Reflection:
    """The ray from `point (3,)` along `towards (3,)` to `light`, standard `error` in radians.

    The point is in metres, the origin if the ball is not `placed`.
    """

    light: str
    point: Array
    towards: Array
    error: float
    placed: bool


@dataclass(frozen=True, eq=False)
class FoundLight:
    """A light in `direction (3,)` from `origin (3,)` with its standard `error` in radians.

    `distance` in metres has a relative standard error of `unsure`; None if undetermined.
    """

    origin: Array
    direction: Array
    error: float
    distance: float | None = None
    unsure: float = np.inf

    def position(self, radius: float | None) -> Array | None:
        """Its position, or that at `radius` metres from the stage's origin, else None."""
        along = self.distance
        if along is None and radius is not None:
            middle = -float(self.origin @ self.direction)
            square = middle**2 - float(self.origin @ self.origin) + radius**2
            along = middle + float(np.sqrt(max(square, 0)))
        return None if along is None else self.origin + along * self.direction


def find_highlight(
    image: AnyFloats, bad: Bools, circle: Circle
) -> tuple[Array, float, bool] | None:
    """The brightest spot of a grey `image (H, W)` with saturated pixels `bad` in `circle`, or None.

    Its pixel `(2,)`, the share of the disc above half of the peak, whether other spots are alike.
    """
    y, x = np.indices(image.shape)
    inside = np.hypot(x - circle[0], y - circle[1]) < INNER * circle[2]
    if not inside.any():
        return None
    middle = float(np.median(image[inside]))
    noise = 1.4826 * float(np.median(np.abs(image[inside] - middle)))
    values = np.where(inside, image - middle, 0.0)
    peak = float(values.max())
    if not peak > max(8 * noise, 1e-3 * middle, 0):
        return None
    spots, count = ndimage.label(inside & ((values > max(4 * noise, 0.3 * peak)) | bad))
    light = ndimage.sum(values, spots, np.arange(1, count + 1))
    area = int((values > 0.5 * peak).sum())
    spot = ndimage.binary_dilation(spots == 1 + light.argmax()) & inside
    weight = np.where(spot, np.maximum(values - 0.15 * peak, 0), 0)
    at = np.array([(x * weight).sum(), (y * weight).sum()]) / weight.sum()
    share = 0.0 if area <= SPOT_PIXELS else area / int(inside.sum())
    return at, share, bool((light > SECOND * light.max()).sum() > 1)


def highlights(
    images: Mapping[str, tuple[AnyFloats, Bools]], circle: Circle
) -> tuple[dict[str, Array], int] | None:
    """Pixels by light in the frames, grey `(H, W)` and saturated, of single lights, and how many
    lights have several alike; None if `circle` is not a mirror ball's.

    What is the same under all of three lights or more is subtracted.
    """
    x, y, radius = circle
    box = np.s_[max(0, int(y - radius) - 2) :, max(0, int(x - radius) - 2) :]
    corner = np.array([box[1].start, box[0].start])
    size = np.s_[: int(2 * radius) + 6, : int(2 * radius) + 6]
    cut = {n: (image[box][size], bad[box][size]) for n, (image, bad) in images.items()}
    same = np.min([v for v, _ in cut.values()], axis=0) if len(cut) > 2 else 0.0
    fixed: Bools = np.all([bad for _, bad in cut.values()], axis=0) & (len(cut) > 2)
    local = (x - corner[0], y - corner[1], radius)
    each = {n: find_highlight(v - same, bad & ~fixed, local) for n, (v, bad) in cut.items()}
    shown = {n: found for n, found in each.items() if found is not None}
    if not shown or np.median([share for _, share, _ in shown.values()]) > SPOT:
        return None
    pixels = {n: at + corner for n, (at, _, several) in shown.items() if not several}
    return pixels, len(shown) - len(pixels)


def cone(camera: Camera, circle: Circle) -> tuple[Array, float]:
    """Axis `(3,)` and sine of the half angle of the rays through a ball's outline."""
    angle = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    rim = np.stack([circle[k] + circle[2] * f(angle) for k, f in enumerate((np.cos, np.sin))], -1)
    axis = np.linalg.lstsq(camera.rays(rim), np.ones(len(rim)), rcond=None)[0]
    length = float(np.linalg.norm(axis))  # 1 / the cosine
    return np.asarray(axis / length), float(np.sqrt(1 - 1 / length**2))


def group(
    circles: Mapping[str, Sequence[Circle]], cameras: Mapping[str, Camera], radius: float | None
) -> list[tuple[dict[str, Circle], Array | None, float]]:
    """Each ball's outline by camera, its centre `(3,)` (None if unplaced) and radius, metres."""
    left = [(name, circle) for name, some in circles.items() for circle in some]
    out: list[tuple[dict[str, Circle], Array | None, float]] = []
    while left:
        name, first = left.pop(0)
        ball, placed = {name: first}, None
        for other, circle in list(left):
            if other not in ball and (new := _placed({**ball, other: circle}, cameras, radius)):
                ball, placed = {**ball, other: circle}, new
                left.remove((other, circle))
        if placed is not None:
            out.append((ball, placed.center, placed.radius))
        elif radius is not None:
            axis, sine = cone(cameras[name], first)
            out.append((ball, cameras[name].center + axis * radius / sine, radius))
        else:
            out.append((ball, None, 1.0))
    return out


def _placed(
    ball: dict[str, Circle], cameras: Mapping[str, Camera], radius: float | None
) -> PlacedBall | None:
    try:
        placed = PlacedBall.of(GreyBall(ball), cameras)
    except ValueError:
        return None
    far = [float(np.linalg.norm(placed.center - cameras[n].center)) for n in ball]
    sizes = [cone(cameras[n], c)[1] * d for (n, c), d in zip(ball.items(), far, strict=True)]
    return placed if np.allclose(sizes, radius or placed.radius, rtol=SAME_SIZE) else None


def reflect(
    camera: Camera, circle: Circle, center: Array | None, radius: float, light: str, pixel: Array
) -> Reflection | None:
    """The ray to a `light` whose highlight is at `pixel (2,)`, None beside the ball or grazing."""
    axis, sine = cone(camera, circle)
    ray = camera.rays(pixel)
    along = float(ray @ axis) / sine  # of a ball of radius 1 at 1 / sine
    inside = along**2 - 1 / sine**2 + 1
    normal = (along - np.sqrt(max(inside, 0))) * ray - axis / sine
    cosine = -float(ray @ normal)
    if inside <= 0 or cosine < GRAZING:
        return None
    point = np.zeros(3) if center is None else center + radius * normal
    error = 2 * PIXEL / (circle[2] * cosine)
    return Reflection(light, point, ray + 2 * cosine * normal, error, center is not None)


def locate(rays: Sequence[Reflection]) -> FoundLight:
    """Where the `rays` to one light meet, else their mean direction; at least one ray."""
    rays = [r for r in rays if r.placed] or rays
    point, towards = (np.array([getattr(r, f) for r in rays]) for f in ("point", "towards"))
    error = np.array([r.error for r in rays])
    origin, mean = (np.average(v, axis=0, weights=error**-2) for v in (point, towards))
    mean /= np.linalg.norm(mean)
    across = np.linalg.svd(mean[None])[2][1:]
    alone = FoundLight(origin, mean, float(np.sqrt(1 / (error**-2).sum())))

    def residual(x: Array) -> Array:
        to = mean + x[:2] @ across + (origin - point) * x[2]
        to /= np.linalg.norm(to, axis=1, keepdims=True)
        return np.asarray(((to - towards) / error[:, None]).ravel())

    if len(rays) < 2 or not rays[0].placed:
        return alone
    found = least_squares(residual, [0.0, 0.0, 0.7], x_scale=[0.01, 0.01, 0.1])
    scale = max(1.0, 2 * found.cost / max(2 * len(rays) - 3, 1))
    variance = scale * np.linalg.pinv(found.jac.T @ found.jac, hermitian=True)[2, 2]
    unsure = float(np.sqrt(variance)) / max(float(found.x[2]), 1e-9)
    if not 0 < unsure < DETERMINED:
        return alone
    aim = (mean + found.x[:2] @ across) / found.x[2]
    away = float(np.linalg.norm(aim))
    return FoundLight(origin, aim / away, alone.error, away, unsure)


def compared(rays: Sequence[Reflection], lights: Mapping[str, Light]) -> dict[str, float]:
    """By light, the mean angle between `rays` and the ways to its given position, degrees."""
    out: dict[str, list[float]] = {}
    for r in rays:
        if r.light in lights:
            to = lights[r.light].position - r.point
            cosine = float(to @ r.towards / np.linalg.norm(to))
            out.setdefault(r.light, []).append(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    return {name: float(np.mean(angles)) for name, angles in out.items()}

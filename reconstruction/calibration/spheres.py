"""What cameras see of a sphere: its outline, and the highlights of a mirror one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from reconstruction.arrays import AnyFloats, Array, Bools
from reconstruction.calibration.boards import CalibrationError
from reconstruction.calibration.least_squares import minimise, numeric
from reconstruction.geometry.cameras import Camera
from reconstruction.images.silhouettes import background_noise

RIM = 0.2  # pixels: what a point of the outline is off by
SPOT = 0.3  # pixels: a highlight within one pixel, anywhere in it
OTHER_RADIUS = 0.01
"""A radius is another than the outlines' by more than this share of it, and 2.5 times `RIM`."""


@dataclass(frozen=True, eq=False)
class Highlight:
    """A light's mirror image: its centre `pixel (2,)`, and `deviation` of it in pixels."""

    pixel: Array
    deviation: float
    saturated: bool


def find_outline(image: AnyFloats) -> Array:
    """Sub-pixel points `(N, 2)` of the rim of the one lit blob in a dark-subtracted grey `image`.

    Along 120 rays from its centroid, where the light falls to half of what it is two pixels inside.
    Directions in which the rim is dark are left out; none where nothing is lit.
    """
    noise, bright = background_noise(image), float(np.percentile(image, 99))
    lit = image > max(6 * noise, 0.05 * bright)
    labels, count = ndimage.label(lit)
    if count == 0 or not bright > 0:
        return np.zeros((0, 2))
    area = np.bincount(labels.ravel())
    area[0] = 0
    if area.max() < 50:
        return np.zeros((0, 2))
    y, x = np.nonzero(labels == area.argmax())
    middle = np.array([x.mean(), y.mean()])
    reach = 1.5 * np.sqrt(area.max() / np.pi) + 4
    radii = np.arange(0, reach, 0.25)
    angle = np.linspace(0, 2 * np.pi, 120, endpoint=False)
    along = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    at = middle + radii[:, None, None] * along
    inside = ((at >= 0) & (at <= np.array(image.shape[::-1]) - 1)).all(axis=-1).all(axis=0)
    profile = ndimage.map_coordinates(image, at[..., ::-1].transpose(2, 0, 1), order=1, cval=0.0)
    out = []
    for k in np.flatnonzero(inside):
        edge = np.flatnonzero(profile[:, k] > max(6 * noise, 0.05 * bright))[-1]
        level = 0.5 * profile[max(edge - 10, 0), k]
        if level < max(5 * noise, 0.05 * bright):
            continue
        below = np.flatnonzero(profile[max(edge - 10, 0) :, k] < level)
        if not len(below):
            continue
        j = max(edge - 10, 0) + below[0]
        a, b = profile[j - 1, k], profile[j, k]
        out.append(middle + (radii[j - 1] + 0.25 * (a - level) / (a - b)) * along[k])
    return np.array(out).reshape(-1, 2)


def sphere_centre(
    cameras: Sequence[Camera], outlines: Mapping[str, Array], radius: float, what: str
) -> tuple[Array, Array, float | None]:
    """Centre `(3,)` of a sphere of `radius` (metres) from its `outlines`, and covariance `(3, 3)`.

    Rays through the outline pass the centre at one radius; how far outside of the rim all outlines
    are found is solved for, too, or it would be taken for depth. Where that is further than rims
    are found off, the third is the radius that the outlines have, else None. One camera suffices,
    but tells no radius; the more, the better the depth. Raises `CalibrationError` naming `what`
    where no camera has an outline.
    """
    seen = [c for c in cameras if len(outlines.get(c.name, ())) >= 20]
    if not seen:
        raise CalibrationError(
            f"{what}: no camera sees the sphere's outline lit: is it in view in the all_on frame, "
            "in front of a dark background?"
        )
    eyes, rays, sizes, start = [], [], [], []
    for c in seen:
        w = c.rays(outlines[c.name])
        axis = w.mean(axis=0) / np.linalg.norm(w.mean(axis=0))
        angle = float(np.median(np.arccos(np.clip(w @ axis, -1, 1))))
        distance = radius / np.sin(angle)
        start.append(c.center + distance * axis)
        eyes.append(np.broadcast_to(c.center, w.shape))
        rays.append(w)
        sizes.append(np.full(len(w), RIM * distance / c.K[0, 0]))
    eye, ray, size = np.concatenate(eyes), np.concatenate(rays), np.concatenate(sizes)

    def residual(x: Array) -> Array:
        off = np.linalg.norm(np.cross(x[:3] - eye, ray), axis=1)
        return np.append((off - radius) / size - x[3], x[3])

    begin = np.append(np.median(start, axis=0), 0.0)
    solution = minimise(numeric(residual), begin, huber=2.0)
    outside = float(solution.x[3] * np.median(size))
    other = abs(solution.x[3]) > 2.5 and abs(outside) > OTHER_RADIUS * radius
    return solution.x[:3], solution.covariance[:3, :3], radius + outside if other else None


def find_highlight(image: AnyFloats, saturated: Bools) -> Highlight | None:
    """The brightest spot of a dark-subtracted grey `image (H, W)`, None where all is noise.

    Its centre is the mean of its pixels by brightness. A saturated spot's deviation grows with it.
    """
    noise, peak = background_noise(image), float(image.max())
    if peak <= max(8 * noise, 0):
        return None
    spot = (image > max(4 * noise, 0.02 * peak)) | saturated
    labels, _ = ndimage.label(spot, np.ones((3, 3)))
    top = np.unravel_index(int(image.argmax()), image.shape)
    y, x = np.nonzero(labels == labels[top])
    weight = image[y, x].astype(np.float64)
    centre = np.array([x @ weight, y @ weight]) / weight.sum()
    clipped = bool(saturated[y, x].any())
    deviation = SPOT / np.sqrt(len(x))
    if clipped:
        deviation = max(SPOT, 0.2 * np.sqrt(len(x)))
    return Highlight(centre, float(max(deviation, 0.05)), clipped)


def mirrored(eyes: Array, lights: Array, centres: Array, radius: float) -> Array:
    """Points `(N, 3)` of mirror spheres at `centres` where `eyes` see `lights` (all `(N, 3)`).

    The normal halves the angle between the ways to eye and light: iterated, each round is nearer by
    about radius / distance. A light behind the sphere gives a point beyond the rim.
    """
    n = _unit(_unit(eyes - centres) + _unit(lights - centres))
    for _ in range(40):
        at = centres + radius * n
        n = _unit(_unit(eyes - at) + _unit(lights - at))
    return np.asarray(centres + radius * n)


def crossing(eyes: Array, rays: Array) -> tuple[Array, float]:
    """The point `(3,)` nearest to lines `(N, 3)`, and the widest angle between two, radians."""
    rejection = np.eye(3) - rays[:, :, None] * rays[:, None]
    A = rejection.sum(axis=0)
    b = np.einsum("nij,nj->i", rejection, eyes)
    widest = float(np.arccos(np.clip((rays @ rays.T).min(), -1, 1)))
    return np.linalg.lstsq(A, b, rcond=None)[0], widest


def _unit(v: Array) -> Array:
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))

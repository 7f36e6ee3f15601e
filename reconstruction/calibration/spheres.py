"""A sphere in images: its outline, and highlights of a mirror sphere."""

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

RIM = 0.2  # pixels: error of an outline point
SPOT = 0.3  # pixels: error of a highlight within one pixel
OTHER_RADIUS = 0.01
"""Relative difference of the outlines' radius that is reported, if also above 2.5 times `RIM`."""


@dataclass(frozen=True, eq=False)
class Highlight:
    """A light's mirror image: its centre `pixel (2,)` and standard `deviation` in pixels."""

    pixel: Array
    deviation: float
    saturated: bool


def find_outline(image: AnyFloats) -> Array:
    """Sub-pixel points `(N, 2)` of the rim of the one lit blob in a dark-subtracted grey `image`.

    Along 120 rays from its centroid, at half of the value two pixels inside. Directions with a dark
    rim are skipped; empty if nothing is lit.
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

    Rays through the outline are tangent to the sphere; a common offset of all outlines is solved as
    well, since it would bias the depth. If the offset exceeds the error of outlines, the third
    result is their radius, else None. One camera suffices but does not determine the radius. Raises
    `CalibrationError` naming `what` if no camera has an outline.
    """
    used = [c for c in cameras if len(outlines.get(c.name, ())) >= 20]
    if not used:
        raise CalibrationError(
            f"{what}: no camera shows the sphere's lit outline: check that it is in view in the "
            "all_on frame, in front of a dark background"
        )
    eyes, rays, sizes, start = [], [], [], []
    for c in used:
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
    """The brightest spot of a dark-subtracted grey `image (H, W)`, None if all is noise.

    Its centre is the brightness-weighted mean; the deviation of a saturated spot grows with its
    size.
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
    """Reflection points `(N, 3)` of `lights` for `eyes` on mirror spheres at `centres (N, 3)`.

    The normal bisects the directions to eye and light; each iteration reduces the error by about
    radius / distance. A light behind the sphere gives a point beyond the rim.
    """
    n = _unit(_unit(eyes - centres) + _unit(lights - centres))
    for _ in range(40):
        at = centres + radius * n
        n = _unit(_unit(eyes - at) + _unit(lights - at))
    return np.asarray(centres + radius * n)


def crossing(eyes: Array, rays: Array) -> tuple[Array, float]:
    """The point `(3,)` nearest to lines `(N, 3)`, and the largest angle between two, radians."""
    rejection = np.eye(3) - rays[:, :, None] * rays[:, None]
    A = rejection.sum(axis=0)
    b = np.einsum("nij,nj->i", rejection, eyes)
    widest = float(np.arccos(np.clip((rays @ rays.T).min(), -1, 1)))
    return np.linalg.lstsq(A, b, rcond=None)[0], widest


def _unit(v: Array) -> Array:
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))

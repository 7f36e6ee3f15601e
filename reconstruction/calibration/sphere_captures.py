"""Shading samples and highlights of each light from captures of spheres."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product

import numpy as np
from scipy.linalg import block_diag

from reconstruction.arrays import Array, Ints
from reconstruction.calibration.boards import CalibrationError
from reconstruction.calibration.shading import Shading
from reconstruction.calibration.solve_lights import Glint
from reconstruction.calibration.spheres import find_highlight, find_outline, sphere_centre
from reconstruction.capture.folder import Capture
from reconstruction.geometry.cameras import Camera
from reconstruction.images.silhouettes import (
    NoSilhouette,
    background_noise,
    lit_image,
)

Samples = tuple[Array, Array, Ints, Array, Array]

MOST = 4000  # pixels per camera
RIM = 0.35  # least cosine to the viewer of a sample


def gather_shading(
    captures: Sequence[Capture],
    cameras: Sequence[Camera],
    radius: float,
    albedo: float,
    lights: Sequence[str],
    warn: Callable[[str], None] = lambda _: None,
) -> dict[str, Shading]:
    """Samples by light of a diffuse sphere, one position per capture; `radius` in metres.

    The sphere is located by its outline in the lit frames; `warn` is called for outlines of another
    radius. Raises `CalibrationError` for a capture without an outline.
    """
    found: dict[str, list[Samples]] = {name: [] for name in lights}
    centres, covariances = [], []
    for number, capture in enumerate(captures):
        outlines = {}
        for c in cameras:
            try:
                outlines[c.name] = find_outline(lit_image(capture, c.name))
            except NoSilhouette:
                continue
        where = f"diffuse sphere in {capture.path}"
        centre, covariance, other = sphere_centre(cameras, outlines, radius, where)
        if other is not None:
            warn(
                f"{where}: its outlines have a radius of {1e3 * other:.1f} mm, expected "
                f"{1e3 * radius:g} mm: measure the sphere (--diffuse-radius-mm); 1 % of the radius "
                "is about 10 % of a light's distance"
            )
        centres.append(centre)
        covariances.append(covariance)
        for c in cameras:
            pixels, rays = _disc(c, centre, radius)
            eyes = np.broadcast_to(c.center, rays.shape)
            for name in lights if len(pixels) else ():
                if not capture.has_light(name, c.name):
                    continue
                image, saturated = capture.light(name, c.name)
                x, y = pixels.T
                ok = ~saturated[y, x]
                values = image[y, x][ok].astype(np.float64)
                error = np.full(len(values), background_noise(image.mean(axis=-1)))
                which = np.full(len(values), number)
                found[name].append((eyes[ok], rays[ok], which, values, error))
    out = {}
    for name, parts in found.items():
        if parts:
            eyes, rays, which, values, error = (np.concatenate(p) for p in zip(*parts, strict=True))
            places = np.array(centres), block_diag(*covariances)
            out[name] = Shading(eyes, rays, which, values, error, *places, radius, albedo)
    if not out:
        raise CalibrationError(
            f"diffuse sphere: none of {[str(c.path) for c in captures]} holds frames of single "
            "lights (OLAT)"
        )
    return out


def glints_of(
    captures: Sequence[Capture], cameras: Sequence[Camera], lights: Sequence[str]
) -> list[Glint]:
    """Highlights on a mirror sphere, one position per capture, of every camera and light."""
    out = []
    for (number, capture), c, name in product(enumerate(captures), cameras, lights):
        if capture.has_light(name, c.name):
            image, saturated = capture.light(name, c.name)
            highlight = find_highlight(image.mean(axis=-1), saturated)
            if highlight is not None:
                out.append(Glint(name, c, number, highlight))
    return out


def _disc(camera: Camera, centre: Array, radius: float) -> tuple[Ints, Array]:
    """Pixels `(N, 2)` well inside the sphere's image, and their rays `(N, 3)`."""
    box = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T
    at, depth = camera.project(centre + radius * box)
    if not (depth > 0).all():
        return np.zeros((0, 2), np.int64), np.zeros((0, 3))
    limit = (camera.width - 1, camera.height - 1)
    ends = np.clip(np.rint([at.min(axis=0), at.max(axis=0)]), 0, limit).astype(int)
    sides = (np.arange(low, high + 1) for low, high in ends.T)
    pixels = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
    rays = camera.rays(pixels.astype(float))
    towards = centre - camera.center
    along = rays @ towards
    inside = along**2 - (towards @ towards - radius**2)
    # the cosine between ray and normal where they meet
    good = (inside > 0) & (np.sqrt(np.maximum(inside, 0)) > RIM * radius)
    pixels, rays = pixels[good], rays[good]
    every = max(1, -(-len(pixels) // MOST))
    return pixels[::every], rays[::every]

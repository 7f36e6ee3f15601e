"""Lights from highlights on mirror spheres, combined with the result of diffuse spheres.

Highlights give accurate directions; distances only by the baseline between spheres. The positions
from shading, with their covariance, are priors in the bundle adjustment of all highlights.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from reconstruction.arrays import Array
from reconstruction.calibration.boards import CalibrationError
from reconstruction.calibration.least_squares import Solution, minimise
from reconstruction.calibration.spheres import Highlight, crossing, mirrored
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.lights import Light

LOOSE = 0.05  # largest standard deviation of a position relative to the distance
SAME_PLACE = np.radians(0.5)  # angle between rays that intersect reliably


@dataclass(frozen=True, eq=False)
class Glint:
    """`highlight` of `light` on mirror sphere number `sphere` in `camera`."""

    light: str
    camera: Camera
    sphere: int
    highlight: Highlight


@dataclass(frozen=True, eq=False)
class CalibratedLight:
    """A calibrated `light` with the `covariance (3, 3)` of its position, m².

    `intensity_deviation` is relative; None if only mirror spheres were used and the intensity is
    nominal.
    """

    light: Light
    covariance: Array
    intensity_deviation: float | None

    @property
    def deviation(self) -> float:
        """Standard deviation of the position in its worst direction, metres."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance)[-1]))


def mirrored_lights(
    nominal: Mapping[str, Light],
    glints: Sequence[Glint],
    radius: float,
    known: Mapping[str, CalibratedLight],
) -> tuple[dict[str, CalibratedLight], Array, float]:
    """Lights from highlights on mirror spheres of `radius`; `known` are results of shading.

    Solves for all lights and sphere centres by the reprojection error of the highlights. Returns
    lights with positions accurate to `LOOSE`, the centres `(S, 3)`, and the RMS in pixels. Raises
    `CalibrationError` for a sphere visible from fewer than two viewpoints.
    """
    names = sorted({g.light for g in glints})
    spheres = 1 + max(g.sphere for g in glints)
    centres = np.array([_place(glints, s, radius) for s in range(spheres)])
    which = np.array([names.index(g.light) for g in glints])
    sphere = np.array([g.sphere for g in glints])
    pixel = np.array([g.highlight.pixel for g in glints])
    error = np.array([g.highlight.deviation for g in glints])
    cameras = {g.camera.name: g.camera for g in glints}
    of = {n: np.array([k for k, g in enumerate(glints) if g.camera.name == n]) for n in cameras}
    eyes = np.array([g.camera.center for g in glints])
    start = _begin(nominal, known, names, glints, centres, radius)
    count = 3 * len(names)

    def residual(x: Array) -> Array:
        place, centre = x[:count].reshape(-1, 3)[which], x[count:].reshape(-1, 3)[sphere]
        at = mirrored(eyes, place, centre, radius)
        out = np.empty((len(glints), 2))
        for name, k in of.items():
            out[k] = (cameras[name].project(at[k])[0] - pixel[k]) / error[k, None]
        return out.ravel()

    # priors from shading: rows weighted by the root of their information
    priors = [
        (k, known[n].light.position, np.linalg.cholesky(np.linalg.inv(known[n].covariance)).T)
        for k, n in enumerate(names)
        if n in known
    ]

    def function(x: Array) -> tuple[Array, sparse.csr_array]:
        r, h = residual(x), 1e-6
        row = np.arange(2 * len(glints))
        entries = []
        # each highlight depends on one light and one sphere: differentiate all at once
        for owner, offset, size in ((which, 0, count), (sphere, count, len(x) - count)):
            for axis in range(3):
                step = np.zeros_like(x)
                step[offset + axis : offset + size : 3] = h
                derivative = (residual(x + step) - residual(x - step)) / (2 * h)
                entries.append((derivative, row, np.repeat(offset + 3 * owner + axis, 2)))
        rest = [W @ (x[3 * k : 3 * k + 3] - p) for k, p, W in priors]
        for i, (k, _, W) in enumerate(priors):
            rows, columns = np.indices((3, 3)).reshape(2, -1)
            entries.append((W.ravel(), 2 * len(glints) + 3 * i + rows, 3 * k + columns))
        value, rows, columns = (np.concatenate(e) for e in zip(*entries, strict=True))
        shape = (2 * len(glints) + 3 * len(priors), len(x))
        return np.concatenate([r, *rest]), sparse.csr_array((value, (rows, columns)), shape=shape)

    solution = minimise(function, np.concatenate([start.ravel(), centres.ravel()]))
    return _calibrated(nominal, known, names, solution, glints)


def _calibrated(
    nominal: Mapping[str, Light],
    known: Mapping[str, CalibratedLight],
    names: Sequence[str],
    solution: Solution,
    glints: Sequence[Glint],
) -> tuple[dict[str, CalibratedLight], Array, float]:
    out = {}
    centres = solution.x[3 * len(names) :].reshape(-1, 3)
    for k, name in enumerate(names):
        at = np.arange(3 * k, 3 * k + 3)
        before = known.get(name)
        light = before.light if before else nominal[name]
        calibrated = CalibratedLight(
            replace(light, position=solution.x[at]),
            solution.covariance[np.ix_(at, at)],
            before.intensity_deviation if before else None,
        )
        distance = np.linalg.norm(calibrated.light.position - centres.mean(axis=0))
        if calibrated.deviation < LOOSE * distance:
            out[name] = calibrated
    pixels = solution.residual[: 2 * len(glints)].reshape(-1, 2)
    pixels = pixels * np.array([g.highlight.deviation for g in glints])[:, None]
    return out, centres, float(np.sqrt((pixels**2).sum(axis=1).mean()))


def _place(glints: Sequence[Glint], sphere: int, radius: float) -> Array:
    """Approximate centre of a mirror sphere.

    A distant light's image lies half a radius before the centre, so the intersections of the rays
    to each light's highlight lie on a sphere of half the radius.
    """
    images = []
    widest = 0.0
    mine = [g for g in glints if g.sphere == sphere]
    for light in sorted({g.light for g in mine}):
        of = [g for g in mine if g.light == light]
        eyes = np.array([g.camera.center for g in of])
        rays = np.array([g.camera.rays(g.highlight.pixel) for g in of])
        at, angle = crossing(eyes, rays)
        widest = max(widest, angle)
        if angle > 4 * SAME_PLACE:
            images.append(at)
    if not images:
        who = sorted({g.camera.name for g in mine})
        raise CalibrationError(
            f"mirror sphere {sphere + 1}: no highlight is visible from two viewpoints ({who}, at "
            f"most {np.degrees(widest):.2g}° apart): place it in view of a second camera"
        )
    v = np.array(images)
    if len(v) < 6:
        return np.asarray(v.mean(axis=0))
    middle = v.mean(axis=0)
    A = np.column_stack([2 * (v - middle), np.ones(len(v))])
    fit = np.linalg.lstsq(A, ((v - middle) ** 2).sum(axis=1), rcond=1e-3)[0][:3]
    fit *= min(1.0, radius / max(float(np.linalg.norm(fit)), 1e-12))
    return np.asarray(middle + fit)


def _begin(
    nominal: Mapping[str, Light],
    known: Mapping[str, CalibratedLight],
    names: Sequence[str],
    glints: Sequence[Glint],
    centres: Array,
    radius: float,
) -> Array:
    """Initial positions `(L, 3)`: along the mean mirrored ray at the nominal distance."""
    out: Array = np.empty((len(names), 3))
    for k, name in enumerate(names):
        if name in known:
            out[k] = known[name].light.position
            continue
        rays: list[Array] = []
        for g in (g for g in glints if g.light == name):
            centre, w = centres[g.sphere], g.camera.rays(g.highlight.pixel)
            along = (centre - g.camera.center) @ w
            off = centre - g.camera.center - along * w
            deep = np.sqrt(max(radius**2 - off @ off, 0.0))
            n = (g.camera.center + (along - deep) * w - centre) / radius
            n = n / np.linalg.norm(n)
            rays.append(w - 2 * (w @ n) * n)
        ray: Array = np.mean(rays, axis=0)
        middle: Array = centres.mean(axis=0)
        away = np.linalg.norm(nominal[name].position - middle)
        out[k] = middle + ray * (away / max(float(np.linalg.norm(ray)), 1e-9))
    return out

"""Directions of hair from highlights under hundreds of single lights.

A fibre reflects light into the cone about its tangent, so that a pixel's OLAT responses determine
the tangent even if no fibre is resolved. Photobooth §4.2 refines orientations with Kajiya-Kay; here
the model is a table filled from the points of most confident texture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from reconstruction.arrays import AnyFloats, Array, Bools, Floats, Ints
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.lights import Light
from reconstruction.tangents.line_evidence import Tangents

FEWEST_LIGHTS = 60  # with fewer, over 15 degrees apart, the highlight falls between lights

_SUMS, _AZIMUTHS, _TILTS, _FACINGS = 18, 4, 2, 8
_LARGEST_SUM = 1.4
_GRAZING = 0.1
_BRIGHTEST = 6.0
_BLOCK = 0.03
_MOST_ALIKE = 0.99  # correlation, limited by the error of the table
_TOGETHER = 1 << 13  # points whose vectors to all lights are in memory at once
_TRUSTED = 0.4  # of the points, the most confident ones


def surface_normals(points: Array, towards: Array, neighbours: int = 40) -> Array:
    """Unit normals `(N, 3)` of the plane through each point's neighbours, facing `towards (N, 3)`.

    Hoppe et al. 1992, as in Photobooth §3.2.
    """
    k = min(neighbours, len(points))
    if k < 3:
        return towards / np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
    near = points[cKDTree(points).query(points, k=k)[1]]
    near = near - near.mean(axis=1, keepdims=True)
    _, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", near, near))
    normals = vectors[:, :, 0]
    return np.where((normals * towards).sum(axis=1, keepdims=True) < 0, -normals, normals)


@dataclass(frozen=True, eq=False)
class OlatStack:
    """A camera's frames under L single lights: `olat (L, H, W)` and `known (L, H, W)`, false where
    saturated or missing."""

    camera: Camera
    olat: AnyFloats
    known: Bools

    @property
    def shot(self) -> Bools:
        """Lights `(L,)` with any known pixel."""
        return np.asarray(self.known.any(axis=(1, 2)))


@dataclass(frozen=True, eq=False)
class Observations:
    """One camera's OLAT responses at its visible points.

    `index (P,)` into the points; `response (P, L)`, corrected for the light's distance and
    intensity and divided by the mean over the lights in front; `known (P, L)`; metres of
    `points (P, 3)` and `lights (L, 3)`; unit vectors `normals (P, 3)` and `to_camera (P, 3)`.
    """

    index: Ints
    response: Floats
    known: Bools
    points: Array
    normals: Array
    lights: Array
    to_camera: Floats

    def towards(self, some: Ints | slice) -> tuple[Floats, Floats]:
        """Unit vectors to the lights `(Q, L, 3)` at `some` points, and their cosines to the normals
        `(Q, L)`; four times the memory of the responses."""
        away = self.lights - self.points[some][:, None]
        to_light = away / np.sqrt((away**2).sum(axis=2))[..., None]
        to_light = to_light.astype(np.float32)
        normals = self.normals[some].astype(np.float32)
        return to_light, np.einsum("pld,pd->pl", to_light, normals)

    @property
    def parts(self) -> list[slice]:
        """All points, `_TOGETHER` at once."""
        return [slice(k, k + _TOGETHER) for k in range(0, len(self.index), _TOGETHER)]


def observe(
    stack: OlatStack,
    lights: Sequence[Light],
    points: Array,
    normals: Array,
    visible: Bools,
) -> Observations:
    """Responses of a camera under each light at those of `points (N, 3)` `visible (N,)` in it."""
    camera, index = stack.camera, np.flatnonzero(visible)
    to_camera = camera.center - points[index]
    to_camera /= np.linalg.norm(to_camera, axis=1, keepdims=True)
    out = Observations(
        index,
        np.zeros((len(index), len(lights)), np.float32),
        np.zeros((len(index), len(lights)), bool),
        points[index],
        normals[index],
        np.stack([light.position for light in lights]),
        to_camera.astype(np.float32),
    )
    pixels, _ = camera.project(out.points)
    for part in out.parts:
        x, y = np.rint(pixels[part]).astype(int).T
        at = out.points[part]
        square = ((out.lights - at[:, None]) ** 2).sum(axis=2)
        strength = np.stack([x.intensity_towards(at).mean(axis=-1) for x in lights], axis=1)
        shines = strength > 0  # frames of a dark light are noise
        known = stack.known[:, y, x].T & shines
        response = np.maximum(stack.olat[:, y, x].T, 0) * square
        response = np.divide(response, strength, out=np.zeros_like(response), where=shines)
        front = (out.towards(part)[1] > _GRAZING) & known
        mean = (response * front).sum(axis=1) / np.maximum(front.sum(axis=1), 1)
        response = response / np.maximum(mean, 1e-30)[:, None]
        # responses are clipped at `_BRIGHTEST`: a brighter saturated one is as good as known
        out.known[part] = known | ((response >= _BRIGHTEST) & stack.shot)
        out.response[part] = np.minimum(response, _BRIGHTEST)
    return out


def _cell(sin_i: Floats, sin_r: Floats, cos_between: Floats) -> Ints:
    """Cell of the reflection table for sines of inclination to light and camera."""
    cos = np.sqrt(np.maximum((1 - sin_i**2) * (1 - sin_r**2), 1e-6))
    azimuth = np.clip((cos_between - sin_i * sin_r) / cos, -1, 1)
    s = np.minimum((np.abs(sin_i + sin_r) * (_SUMS / _LARGEST_SUM)).astype(np.int64), _SUMS - 1)
    a = np.minimum(((azimuth + 1) * (0.5 * _AZIMUTHS)).astype(np.int64), _AZIMUTHS - 1)
    r = np.minimum((np.abs(sin_r) * _TILTS).astype(np.int64), _TILTS - 1)
    return np.asarray((s * _AZIMUTHS + a) * _TILTS + r)


def _facing_cell(facing: Floats) -> Ints:
    return np.clip(((facing + 0.2) * (_FACINGS / 1.2)).astype(np.int64), 0, _FACINGS - 1)


@dataclass(frozen=True, eq=False)
class Reflection:
    """Reflectance table of the capture's hair over geometry, mean 1 in front of the light.

    `lit (8,)` is the mean response over the cosine of the light to the surface (shading and
    shadow); `lobe (18·4·2,)` the mean of the remaining factor over |sin θ_i + sin θ_r| (0 on the
    mirror cone), cos φ between light and camera around the fibre, and |sin θ_r|.
    """

    lit: Array
    lobe: Array

    @classmethod
    def learn(
        cls, observations: Sequence[Observations], directions: Array, trusted: Bools
    ) -> Reflection:
        """Fill the table from the `trusted (N,)` ones of `directions (N, 3)`."""
        total, count = np.zeros(_FACINGS), np.zeros(_FACINGS)
        for o in observations:
            for part in o.parts:
                known = o.known[part]
                cell = _facing_cell(o.towards(part)[1])[known]
                total += np.bincount(cell, o.response[part][known], _FACINGS)
                count += np.bincount(cell, minlength=_FACINGS)
        lit = np.maximum((total + 1e-3) / (count + 1e-3), 1e-3)
        size = _SUMS * _AZIMUTHS * _TILTS
        total, count = np.zeros(size), np.zeros(size)
        for o in observations:
            every = np.flatnonzero(trusted[o.index])
            for k in range(0, len(every), _TOGETHER):
                m = every[k : k + _TOGETHER]
                t = directions[o.index[m]].astype(np.float32)
                to_light, facing = o.towards(m)
                sin_i = np.einsum("pld,pd->pl", to_light, t)
                sin_r = (o.to_camera[m] * t).sum(axis=1, keepdims=True)
                between = np.einsum("pld,pd->pl", to_light, o.to_camera[m])
                cell = _cell(sin_i, sin_r, between)
                front = (facing > _GRAZING) & o.known[m]
                ratio = np.minimum(o.response[m] / lit[_facing_cell(facing)], _BRIGHTEST)
                total += np.bincount(cell[front], ratio[front], size)
                count += np.bincount(cell[front], minlength=size)
        return cls(lit, (total + 1) / (count + 1))

    @property
    def contrast(self) -> float:
        """Lobe on the mirror cone over lobe far from it: 1 has no information on directions."""
        sums = self.lobe.reshape(_SUMS, -1)
        return float(sums[:4].mean() / max(float(sums[8:].mean()), 1e-9))

    def scores(self, o: Observations, points: Array, candidates: Array) -> Floats:
        """Log-likelihoods `(P, D)` of `candidates (D, 3)`, per response: 0 is no information.

        -½ log(1 - ρ²), ρ the correlation of responses with the table's, clipped to positive:
        scale and noise are unknown. Weighted by `lit`, against lights in shadow; on square roots,
        against single bright lights. Points of one cell of 3 cm share the directions to lights and
        camera.
        """
        out = np.zeros((len(o.index), len(candidates)), np.float32)
        model = np.sqrt(self.lobe).astype(np.float32)
        c = candidates.astype(np.float32)
        cell = np.floor(points[o.index] / _BLOCK).astype(np.int64)
        _, block = np.unique(cell, axis=0, return_inverse=True)
        order = np.argsort(block.ravel(), kind="stable")
        for m in np.split(order, np.flatnonzero(np.diff(block.ravel()[order])) + 1):
            each, facing = o.towards(m)
            lit = self.lit[_facing_cell(facing)]
            w = np.where((facing > _GRAZING) & o.known[m], lit, 0).astype(np.float32)
            y = np.sqrt(np.minimum(o.response[m] / lit, _BRIGHTEST)).astype(np.float32)
            to_light = each.mean(axis=0)
            to_light /= np.linalg.norm(to_light, axis=1, keepdims=True)
            to_camera = o.to_camera[m].mean(axis=0)
            to_camera /= np.linalg.norm(to_camera)
            sin_i, sin_r = to_light @ c.T, (c @ to_camera)[None]
            predicted = model[_cell(sin_i, sin_r, (to_light @ to_camera)[:, None])]
            total = w.sum(axis=1, keepdims=True) + 1e-9
            y = y - (w * y).sum(axis=1, keepdims=True) / total
            mean = (w @ predicted) / total
            variance = w @ (predicted * predicted) - total * mean**2
            spread = variance * (w * y * y).sum(axis=1, keepdims=True)
            alike = ((w * y) @ predicted) / np.sqrt(np.maximum(spread, 1e-9))
            out[m] = -0.5 * np.log1p(-(np.clip(alike, 0, _MOST_ALIKE) ** 2))
        return out


def learned(observations: Sequence[Observations], known: Tangents) -> Reflection:
    """The reflection table, filled from the most confident of the tangents `known`."""
    trusted = known.confidence >= np.quantile(known.confidence, 1 - _TRUSTED)
    return Reflection.learn(observations, known.directions, trusted)

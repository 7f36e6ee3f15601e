"""How what a pixel's fibres scatter changes as they turn: for highlights at wrong places.

Strands whose directions are off have their highlights at wrong places, and harmonics of low degree
cannot move those. The derivative of a fibre's lobes can: its product with two angles is, to first
order, what turned fibres scatter, whatever the directions of camera and light.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.sparse import csr_matrix

from appearance.bsdf.longitudinal import variance_of_roughness
from appearance.fields.hits import Hits
from appearance.render.harmonics import count_of, harmonics
from reconstruction.arrays import Floats
from reconstruction.geometry.lights import dome_positions

COUNT = 3
"""What a place has: a factor, and turns towards the strand's binormal and its normal."""
DEGREE = 3
"""Of the harmonics of the light's direction that stand for a derivative at a pixel."""
_UNIT = 0.15
"""Radians that a coefficient of 1 turns by."""
_STEP = 0.03
_MOST = 3.0
_TILT = np.radians(2.0)
_HITS = 8
"""Of a pixel's hits, evenly chosen: its fibres' lobes vary slowly within it."""
_AT_ONCE = 1 << 11
"""Pixels whose hits are in memory at once."""
_DIRECTIONS = dome_positions(64, 1.0)


def turning_features(hits: Hits, beta_m: float) -> Floats:
    """What 1 and the two derivatives are under light from anywhere: `(P, 3, n)`.

    Harmonics up to `DEGREE` of the direction to the light in the world: how the logarithm of what
    a pixel's hits scatter changes by turns of `_UNIT`; fitted where they scatter much.
    """
    parts = [
        _features(
            replace(hits, pixels=hits.pixels[k : k + _AT_ONCE], table=hits.table[k : k + _AT_ONCE]),
            beta_m,
        )
        for k in range(0, len(hits.pixels), _AT_ONCE)
    ]
    return np.concatenate([np.zeros((0, COUNT, count_of(DEGREE)), np.float32), *parts])


def _features(hits: Hits, beta_m: float) -> Floats:
    few = hits.table[:, :: max(1, hits.count // _HITS)]
    on = few["strand"] >= 0
    pixel = np.nonzero(on)[0]
    some = few[on]
    away = hits.camera.center - some["point"]
    away = away / np.maximum(np.linalg.norm(away, axis=-1, keepdims=True), 1e-12)
    tangent, normal = some["tangent"], some["normal"]
    frames = np.stack([np.cross(tangent, normal), normal, tangent], axis=-1)
    camera = np.einsum("hi,hij->hj", away, frames).astype(np.float32)[:, None]
    light = np.einsum("qi,hij->hqj", _DIRECTIONS, frames).astype(np.float32)
    shape = len(hits.pixels), len(some)
    added = csr_matrix((some["weight"], (pixel, np.arange(len(some)))), shape=shape)
    width = float(np.sqrt(variance_of_roughness(beta_m)))
    scattered = _lobes(light, camera, width)
    y = harmonics(_DIRECTIONS, DEGREE)
    whole = np.asarray(added @ scattered)
    n = y.shape[1]
    least = 1e-3 * whole.mean(axis=1)[:, None, None] + 1e-12
    squares = np.matmul(y.T[None] * whole[:, None], y) + least * np.eye(n, dtype=np.float32)
    out = np.zeros((len(hits.pixels), COUNT, n), np.float32)
    out[:, 0, 0] = 1 / y[0, 0]
    for k, axis in enumerate(np.eye(3, dtype=np.float32)[:2], 1):
        turned = _lobes(_turned(light, axis), _turned(camera, axis), width)
        change = np.clip(np.log(turned / scattered) * (_UNIT / _STEP), -_MOST, _MOST)
        right = np.asarray(added @ (scattered * change)) @ y
        out[:, k] = np.linalg.solve(squares, right[..., None])[..., 0]
    return out


def _turned(x: Floats, axis: Floats) -> Floats:
    """Unit directions `(…, 3)` in the frame whose tangent is turned by a step towards `axis`."""
    across = x @ axis
    out = x - _STEP * x[..., 2:] * axis
    out[..., 2] += _STEP * across
    return np.asarray(out / np.linalg.norm(out, axis=-1, keepdims=True))


def _lobes(light: Floats, camera: Floats, width: float) -> Floats:
    """About what a fibre along z scatters: R, TT, TRT as Gaussians (Marschner 2003), and a rest.

    `light (H, Q, 3)` and `camera (H, 1, 3)` are unit directions; the longitudinal lobes have a
    standard deviation of `width`, a half and twice of it. Returns `(H, Q)`.
    """
    theta, other = (np.arcsin(np.clip(x[..., 2], -1, 1)) for x in (light, camera))
    across = np.linalg.norm(light[..., :2], axis=-1) * np.linalg.norm(camera[..., :2], axis=-1)
    cosine = (light[..., :2] * camera[..., :2]).sum(axis=-1) / np.maximum(across, 1e-6)
    phi = np.arccos(np.clip(cosine, -1, 1))
    half = np.cos(0.5 * phi)
    along = theta + other

    def lobe(shift: float, size: float) -> Floats:
        return np.asarray(np.exp(-0.5 * ((along - shift) / size) ** 2) / size)

    through = np.exp(-0.5 * ((np.pi - phi) / 0.35) ** 2)
    total = 0.25 * lobe(-2 * _TILT, width) * half + 0.25 * lobe(4 * _TILT, 2 * width) * half**2
    total += 0.4 * lobe(_TILT, 0.5 * width) * through + 0.0075
    return np.asarray(total * np.maximum(np.cos(theta), 1e-3), np.float32)

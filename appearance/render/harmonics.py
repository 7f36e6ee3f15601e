"""Real spherical harmonics up to degree 3, on NumPy's and on Dr.Jit's arrays alike."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from reconstruction.arrays import Array, Floats, Ints
from reconstruction.geometry.lights import dome_positions

MOST_DEGREE = 3


def count_of(degree: int) -> int:
    """Number of harmonics up to `degree`."""
    return (degree + 1) ** 2


def degrees(degree: int) -> Ints:
    """The degree of each harmonic `(n,)`."""
    return np.concatenate([np.full(2 * k + 1, k) for k in range(degree + 1)])


def terms(degree: int, x: Any, y: Any, z: Any) -> list[Any]:
    """The harmonics of the unit vector (x, y, z), orthonormal over the sphere, degree by degree.

    Condon-Shortley's phase is left out: within degree 1 they are in the order y, z, x. Raises
    `ValueError` above degree 3.
    """
    if not 0 <= degree <= MOST_DEGREE:
        raise ValueError(f"harmonics go from degree 0 to {MOST_DEGREE}, got {degree}")
    out = [0.28209479177387814 + 0 * x]
    if degree > 0:
        out += [0.4886025119029199 * a for a in (y, z, x)]
    if degree > 1:
        out += [1.0925484305920792 * a for a in (x * y, y * z)]
        out += [0.31539156525252005 * (3 * z * z - 1), 1.0925484305920792 * x * z]
        out += [0.5462742152960396 * (x * x - y * y)]
    if degree > 2:
        xx, yy, zz = x * x, y * y, z * z
        out += [
            0.5900435899266435 * y * (3 * xx - yy),
            2.890611442640554 * x * y * z,
            0.4570457994644658 * y * (5 * zz - 1),
            0.3731763325901154 * z * (5 * zz - 3),
            0.4570457994644658 * x * (5 * zz - 1),
            1.445305721320277 * z * (xx - yy),
            0.5900435899266435 * x * (xx - 3 * yy),
        ]
    return out


def harmonics(directions: ArrayLike, degree: int) -> Floats:
    """The harmonics `(…, n)` of `directions (…, 3)` of any length; those of none are not finite."""
    d = np.asarray(directions, np.float64)
    x, y, z = np.moveaxis(d / np.linalg.norm(d, axis=-1, keepdims=True), -1, 0)
    return np.stack(terms(degree, x, y, z), axis=-1).astype(np.float32)


def turns(frames: ArrayLike, degree: int) -> list[Floats]:
    """Rotations of harmonics by frames: for each degree k from 1 a block `(H, 2k + 1, 2k + 1)`.

    `frames (H, 3, 3)` have their axes as columns. The harmonics in a frame, Y(Fᵀω), are the block
    times those in the world, Y(ω).
    """
    directions, inverse = _probes(degree)
    local = harmonics(np.einsum("qi,hij->hqj", directions, np.asarray(frames, float)), degree)
    out = []
    for k in range(1, degree + 1):
        part = slice(k * k, (k + 1) ** 2)
        block = np.einsum("hqi,jq->hij", local[..., part], inverse[k])
        out.append(np.ascontiguousarray(block, np.float32))
    return out


@lru_cache
def _probes(degree: int) -> tuple[Array, list[Array]]:
    """Directions, and for each degree what takes values there to the harmonics' coefficients."""
    directions = dome_positions(4 * count_of(degree), 1.0)
    known = harmonics(directions, degree).astype(float)
    blocks = [known[:, k * k : (k + 1) ** 2] for k in range(degree + 1)]
    return directions, [np.linalg.pinv(b) for b in blocks]


def projected(envmap: ArrayLike, rotation_deg: float, degree: int) -> Array:
    """Integrals over the sphere of a lat-long map times each harmonic: `(n, 3)`.

    `envmap (h, w, 3)` is oriented as `render_environment` has it.
    """
    light = np.asarray(envmap, float)
    height, width = light.shape[:2]
    # texels are constant and harmonics are not: a few points in each
    fine = max(1, -(-64 // height))
    rows, columns = height * fine, width * fine
    edges = np.cos(np.linspace(0, np.pi, rows + 1))
    z = 0.5 * (edges[:-1] + edges[1:])
    angle = (0.5 + rotation_deg / 360 - (np.arange(columns) + 0.5) / columns) * 2 * np.pi
    radius = np.sqrt(1 - z * z)
    area = (edges[:-1] - edges[1:]) * 2 * np.pi / columns
    total = np.zeros((count_of(degree), 3))
    for i in range(rows):
        row = light[i // fine][np.arange(columns) // fine]
        y = terms(degree, radius[i] * np.cos(angle), radius[i] * np.sin(angle), z[i])
        total += area[i] * np.stack([np.broadcast_to(t, columns) for t in y]) @ row
    return total

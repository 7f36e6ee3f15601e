"""What a person wears besides hair: a striped shirt, glasses, a necklace; and a hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import PchipInterpolator
from skimage.measure import marching_cubes

from appearance.scene.hair_scene import FaceMaterials
from reconstruction import Mesh
from reconstruction.arrays import Array, Bools, Ints
from reconstruction.geometry.signed_distance import blend, capsule, ellipsoid

PARTS = ("skin", "shirt", "glasses", "necklace", "hand")
"""Names of the parts, by `Dressed.part`."""
STRIPE = 1.5e-3
"""Width of a stripe of the shirt at its shoulders, metres: 1 to 3 pixels."""
_RELIEF = 2e-4  # metres between the weave's ridges and grooves
_DARK, _LIGHT = (0.10, 0.13, 0.22), (0.46, 0.47, 0.50)
# Height of the shirt's rings, half-widths in x and y, and their centres' y, metres.
_RINGS = np.array(
    [
        [-0.118, 0.060, 0.062, 0.026],
        [-0.132, 0.066, 0.068, 0.028],
        [-0.146, 0.110, 0.082, 0.030],
        [-0.165, 0.165, 0.096, 0.032],
        [-0.200, 0.200, 0.110, 0.034],
        [-0.270, 0.210, 0.125, 0.034],
    ]
)


@dataclass(frozen=True, eq=False)
class Dressed:
    """The head and all that is worn as one `mesh`, the head's faces first.

    `part (F,)` indexes `PARTS`.
    """

    mesh: Mesh
    materials: FaceMaterials
    part: Ints


def dressed(head: Mesh, skin: Sequence[float]) -> Dressed:
    """The generic `head` of albedo `skin` with a shirt, glasses, a necklace and a hand."""
    shirt, stripe = _shirt()
    meshes = [head, shirt, _glasses(), _necklace(), _hand()]
    part = np.repeat(np.arange(len(PARTS)), [len(m.faces) for m in meshes])
    albedo = np.array([skin, _LIGHT, (0.03, 0.03, 0.03), (0.12, 0.12, 0.11), skin])[part]
    albedo[part == 1] = np.where(stripe[:, None], _LIGHT, _DARK)
    shine = np.array([0, 0, 0.05, 0.6, 0])[part]
    return Dressed(_joined(meshes), FaceMaterials(albedo, shine), part)


def _shirt() -> tuple[Mesh, Bools]:
    """A loft through `_RINGS` in relief, and its faces in light stripes, two faces across."""
    around = 4 * round(np.pi * (0.165 + 0.096) / 2 / STRIPE)  # vertices: two a stripe
    heights = np.linspace(_RINGS[0, 0], _RINGS[-1, 0], 40)
    a, b, y = PchipInterpolator(-_RINGS[:, 0], _RINGS[:, 1:])(-heights).T[:, :, None]
    angle = 2 * np.pi * np.arange(around) / around
    relief = _RELIEF * (np.arange(around) % 2)
    x, y = (a + relief) * np.cos(angle), y + (b + relief) * np.sin(angle)
    points = np.stack([x, y, np.broadcast_to(heights[:, None], x.shape)], axis=-1)
    faces = _tube_faces(len(heights), around)
    light = np.tile(np.arange(around) // 2 % 2 == 1, 2 * (len(heights) - 1))
    return Mesh(points.reshape(-1, 3), faces), light


def _glasses() -> Mesh:
    """Two rims, a bridge and two temples of 1.6 mm radius."""
    t = np.linspace(0, 2 * np.pi, 49)
    bridge = np.array([[-0.011, -0.111, 0.012], [0.0, -0.114, 0.015], [0.011, -0.111, 0.012]])
    pieces = [_tube(bridge)]
    for side in (-1, 1):
        x, z = 0.033 + 0.022 * np.cos(t), 0.006 + 0.018 * np.sin(t)
        y = -0.112 + 4.0 * (x - 0.011) ** 2  # the frame bends around the face
        pieces.append(_tube(np.stack([side * x, y, z], axis=1)))
        temple = np.array([[0.055, -0.104, 0.012], [0.077, -0.070, 0.012], [0.083, 0.0, 0.008]])
        pieces.append(_tube(temple * [side, 1, 1]))
    return _joined(pieces)


def _necklace() -> Mesh:
    """Links of 0.9 mm wire, 5.4 mm long, on a ring around the collar, each turned by 90 degrees."""
    links, t = 110, np.linspace(0, 2 * np.pi, 13)
    pieces = []
    for k in range(links):
        angle = 2 * np.pi * k / links
        out = np.array([np.cos(angle), np.sin(angle), 0.0])
        along = np.array([-np.sin(angle), np.cos(angle), 0.0])
        drop = 0.010 * max(-out[1], 0)  # hangs lower in front
        middle = out * [0.072, 0.074, 0] + [0, 0.028, -0.128 - drop]
        across = out if k % 2 else np.array([0.0, 0.0, 1.0])
        ring = middle + 0.0027 * (np.cos(t)[:, None] * along + np.sin(t)[:, None] * across)
        pieces.append(_tube(ring, 9e-4, 6))
    return _joined(pieces)


def _hand() -> Mesh:
    """A right hand beside the jaw, with a piece of its forearm."""
    cell, low, high = 0.003, np.array([-0.17, -0.16, -0.25]), np.array([-0.06, -0.02, 0.01])
    axes = [np.arange(a, b, cell) for a, b in zip(low, high, strict=True)]
    p = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    d = ellipsoid(p, [-0.108, -0.085, -0.100], [0.016, 0.038, 0.040])
    for y, top in ((-0.112, -0.045), (-0.095, -0.030), (-0.077, -0.034), (-0.060, -0.048)):
        finger = capsule(p, [-0.106, y, -0.085], [-0.092, y, top], 0.0085, 0.0070)
        d = blend(d, finger, 0.004)
    d = blend(d, capsule(p, [-0.112, -0.082, -0.125], [-0.135, -0.080, -0.235], 0.026, 0.032), 0.02)
    vertices, faces, _, _ = marching_cubes(d, 0.0, spacing=(cell,) * 3)
    return Mesh(vertices.astype(float) + low, faces.astype(np.int64))


def _tube(path: Array, radius: float = 1.6e-3, sides: int = 8) -> Mesh:
    """A tube of `radius`, metres, around the polyline `path (N, 3)`, open at its ends."""
    tangent = np.gradient(path, axis=0)
    if np.allclose(path[0], path[-1]):
        tangent[0] = tangent[-1] = tangent[0] + tangent[-1]
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    least = np.eye(3)[np.argmin(np.abs(tangent).max(axis=0))]
    across = np.cross(tangent, least)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    angle = 2 * np.pi * np.arange(sides)[None, :, None] / sides
    around = np.cos(angle) * across[:, None] + np.sin(angle) * np.cross(tangent, across)[:, None]
    points = path[:, None] + radius * around
    return Mesh(points.reshape(-1, 3), _tube_faces(len(path), sides))


def _tube_faces(rings: int, sides: int) -> Ints:
    """Triangles between `rings` of `sides` vertices, closed around."""
    index = np.arange(rings * sides).reshape(rings, sides)
    a, b = index[:-1], index[1:]
    c, d = np.roll(b, -1, axis=1), np.roll(a, -1, axis=1)
    quads = np.stack([a, b, c, d], axis=-1).reshape(-1, 4)
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def _joined(meshes: list[Mesh]) -> Mesh:
    """All `meshes` as one."""
    offsets = np.cumsum([0, *(len(m.vertices) for m in meshes[:-1])])
    faces = [m.faces + k for m, k in zip(meshes, offsets, strict=True)]
    return Mesh(np.concatenate([m.vertices for m in meshes]), np.concatenate(faces))

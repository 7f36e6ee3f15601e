"""Procedural grooms: strands stepped from roots along comb, gravity and the head's surface."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from reconstruction import Mesh, Strands
from reconstruction.arrays import Array, Ints
from reconstruction.geometry.signed_distance import blend, ellipsoid
from reconstruction.head.generic import HEAD_BOX, NECK_END, skin_distance

# A human head: 100,000 fibres of 40 µm. Fewer, thicker strands keep its coverage.
_COVERAGE = 100_000 * 40e-6
_CROWN = np.array([0.012, 0.045, 0.112])  # the whorl sits behind and beside the vertex


@dataclass(frozen=True)
class Groom:
    """Parameters of a style. Lengths in metres, `wave_*` of the offset across the strand."""

    strands: int
    length: tuple[float, float]
    step: float
    parting_x: float | None  # None: no parting, hair leaves the whorl in all directions
    gravity: float  # turn towards down per metre
    lift: float  # thickness of the hair over the scalp, metres
    fringe: float  # hair from above the forehead is cut to this share of its length
    clumps: int
    clumping: float  # how far tips move to the clump's centre, 0 to 1
    wave_radius: float
    wave_pitch: float
    helix: float  # 0: waves in one direction, 1: ringlets
    frizz: float  # random offset of a strand's tip, metres


GROOMS = {
    "wavy": Groom(
        strands=10_500,
        length=(0.10, 0.175),
        step=0.004,
        parting_x=0.022,
        gravity=45.0,
        lift=0.015,
        fringe=1.0,
        clumps=360,
        clumping=0.6,
        wave_radius=0.0052,
        wave_pitch=0.045,
        helix=0.35,
        frizz=0.0012,
    ),
    "straight": Groom(
        strands=11_000,
        length=(0.12, 0.165),
        step=0.005,
        parting_x=0.0,
        gravity=55.0,
        lift=0.010,
        fringe=1.0,
        clumps=700,
        clumping=0.25,
        wave_radius=0.0006,
        wave_pitch=0.090,
        helix=0.0,
        frizz=0.0010,
    ),
    "curly": Groom(
        strands=8_500,
        length=(0.07, 0.115),
        step=0.0025,
        parting_x=None,
        gravity=16.0,
        lift=0.026,
        fringe=0.6,
        clumps=420,
        clumping=0.8,
        wave_radius=0.0042,
        wave_pitch=0.026,
        helix=1.0,
        frizz=0.0012,
    ),
    "coils": Groom(  # type 4C
        strands=7_500,
        length=(0.024, 0.036),
        step=0.00045,
        parting_x=None,
        gravity=3.0,
        lift=0.030,
        fringe=0.9,
        clumps=2_500,
        clumping=0.5,
        wave_radius=0.0040,
        wave_pitch=0.0045,
        helix=1.0,
        frizz=0.0020,
    ),
}


BEARD = Groom(
    strands=3_000,
    length=(0.014, 0.016),
    step=0.001,
    parting_x=None,
    gravity=20.0,
    lift=0.008,
    fringe=1.0,
    clumps=600,
    clumping=0.3,
    wave_radius=0.0008,
    wave_pitch=0.012,
    helix=0.5,
    frizz=0.0010,
)


@dataclass(frozen=True, eq=False)
class HeadField:
    """Signed distance (metres, negative inside) and its gradient on a grid from `low` on."""

    distance: Array
    gradient: Array
    low: Array
    cell: float

    def __call__(self, points: Array) -> tuple[Array, Array]:
        """Distances `(N,)` and unit outward directions `(N, 3)` at `points (N, 3)`."""
        at = ((points - self.low) / self.cell).T
        distance, *gradient = (
            map_coordinates(values, at, order=1, mode="nearest")
            for values in (self.distance, *self.gradient)
        )
        out = np.stack(gradient, axis=1)
        length = np.linalg.norm(out, axis=1, keepdims=True)
        return distance / np.maximum(length[:, 0], 0.3), out / np.maximum(length, 1e-9)


@cache
def hair_field(cell: float = 0.004, bare: bool = False) -> HeadField:
    """`_hair_distance` over the generic head's box, sampled every `cell` metres; that to the skin
    where the face is `bare`."""
    axes = [np.arange(a, b + cell, cell) for a, b in HEAD_BOX.T]
    surface = skin_distance if bare else _hair_distance
    distance = surface(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1))
    gradient = np.array(np.gradient(distance, cell))
    return HeadField(distance, gradient, HEAD_BOX[0], cell)


def _hair_distance(p: Array) -> Array:
    """Signed distance `(...)`, metres, at `p (..., 3)` to the surface under the hair: the skin with
    an infinite neck, filled in front so that hair passes the face."""
    lifted = p.copy()
    lifted[..., 2] = NECK_END + 0.01
    skin = skin_distance(np.where(p[..., 2:] < NECK_END + 0.01, lifted, p))
    guard = ellipsoid(p, [0, -0.062, -0.040], [0.066, 0.075, 0.105])
    return blend(skin, guard, 0.01)


def covering_radius(strands: int) -> float:
    """Radius, metres, at which `strands` have the coverage of 100,000 fibres of 40 µm radius.

    Between 40 µm and 1 mm; 0.35 mm for 11,400 strands.
    """
    return float(np.clip(_COVERAGE / max(strands, 1), 40e-6, 1e-3))


def grow(groom: Groom, head: Mesh, seed: int, count: int | None = None) -> Strands:
    """Strands of `groom` rooted on the scalp of `head`; `count` overrides the number of strands.

    The same arguments give the same bytes. Raises `ValueError` when `head` has no scalp.
    """
    rng, field = np.random.default_rng(seed), hair_field(bare=groom is BEARD)
    roots, normals = _roots(head, count or groom.strands, rng)
    length = _lengths(groom, roots, rng)
    paths = _step(groom, roots, normals, length, field, rng)
    paths = _clump_and_wave(groom, paths, normals, length, rng)
    paths = _push_out(paths, field)
    paths[:, 0] = roots
    counts = np.clip(np.ceil(length / groom.step).astype(np.int64) + 1, 4, paths.shape[1])
    keep = np.arange(paths.shape[1])[None] < counts[:, None]
    offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    return Strands(paths[keep].astype(np.float32), offsets, covering_radius(len(roots)))


def _roots(head: Mesh, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Points `(S, 3)` spread evenly by area over the scalp, and smooth normals there."""
    if head.scalp is None or not head.scalp.any():
        raise ValueError("the head has no marked scalp faces")
    faces = np.flatnonzero(head.scalp)
    area = np.cumsum(head.face_areas()[faces])
    # stratified by area
    at = (np.arange(count) + rng.random(count)) / count * area[-1]
    face = head.faces[faces[np.searchsorted(area, at).clip(max=len(faces) - 1)]]
    u, v = rng.random((2, count))
    flip = u + v > 1
    u, v = np.where(flip, 1 - u, u), np.where(flip, 1 - v, v)
    weights = np.stack([1 - u - v, u, v], axis=1)[..., None]
    normals = (weights * head.vertex_normals()[face]).sum(axis=1)
    return (weights * head.vertices[face]).sum(axis=1), _unit(normals)


def _lengths(groom: Groom, roots: Array, rng: np.random.Generator) -> Array:
    """Layered cut: hair from the crown is longest, the nape shortest; a tenth varies freely."""
    low, high = groom.length
    height = np.clip((roots[:, 2] + 0.05) / 0.165, 0, 1)
    length = low + (high - low) * height
    fringe = np.clip((-0.02 - roots[:, 1]) / 0.04, 0, 1)
    length = length * (1 - (1 - groom.fringe) * fringe)
    return np.asarray(length * np.exp(0.06 * rng.normal(size=len(roots)).clip(-2, 2)))


def _comb(groom: Groom, points: Array) -> Array:
    """Combing directions `(S, 3)`, away from the parting or the whorl."""
    away = points - _CROWN
    if groom.parting_x is None:
        return _unit(away * [1, 1, 0.6])
    side = np.where(points[:, 0] >= groom.parting_x, 1.0, -1.0)
    front = np.clip((0.04 - points[:, 1]) / 0.08, 0, 1)  # behind the whorl there is no parting
    sideways = np.stack([side, 0.30 * np.ones_like(side), np.zeros_like(side)], axis=1)
    return _unit(front[:, None] * sideways + (1 - front[:, None]) * _unit(away))


def _step(
    groom: Groom,
    roots: Array,
    normals: Array,
    length: Array,
    field: HeadField,
    rng: np.random.Generator,
) -> Array:
    """Centre lines `(S, P, 3)` with steps of `groom.step`, all strands at once."""
    count, steps = len(roots), int(np.ceil(length.max() / groom.step)) + 1
    comb = _comb(groom, roots)
    comb = _unit(comb - (comb * normals).sum(1, keepdims=True) * normals)
    comb = _unit(comb + 0.08 * rng.normal(size=comb.shape))
    # hair from above lies over hair from below; a random part mixes the layers
    height = np.clip((roots[:, 2] + 0.05) / 0.165, 0, 1)
    layer = groom.lift * (0.10 + 0.55 * height + 0.35 * rng.random(count))
    sway = 0.25 * rng.normal(size=(count, 3)) * [1, 1, 0.2]
    paths = np.empty((count, steps, 3))
    paths[:, 0] = roots
    direction = _unit(0.9 * normals + 0.7 * comb)
    p = roots.copy()
    for k in range(1, steps):
        s = k * groom.step
        turn = groom.gravity * groom.step
        pull = np.array([0.0, 0.0, -1.0]) * turn + sway * turn * 0.3
        direction = _unit(direction + pull + comb * (0.5 * np.exp(-s / 0.025)))
        p = p + direction * groom.step
        distance, out = field(p)
        shell = layer * (1 - np.exp(-s / 0.012))
        short = np.maximum(shell - distance, 0)
        p = p + short[:, None] * out
        # sliding: remove the component into the head
        into = np.minimum((direction * out).sum(1), 0) * (short > 0)
        direction = _unit(direction - into[:, None] * out)
        moved = _unit(p - paths[:, k - 1])
        p = paths[:, k - 1] + moved * groom.step
        paths[:, k] = p
    return paths


def _clump_and_wave(
    groom: Groom, paths: Array, normals: Array, length: Array, rng: np.random.Generator
) -> Array:
    """Draw strands towards clump centres, then offset clumps along a wave or a helix."""
    count, steps, _ = paths.shape
    guides = rng.choice(count, min(groom.clumps, count), replace=False)
    lock = _nearest(paths[guides, 0], paths[:, 0])
    guide = guides[lock]
    s = np.arange(steps) * groom.step
    along = np.clip(s[None] / length[:, None], 0, 1)
    # Roots spread over the scalp, tips within a lock; some locks are tighter than others.
    tight = groom.clumping * rng.uniform(0.35, 1.0, len(guides))[lock]
    near = np.linalg.norm(paths[guide] - paths, axis=2) < 0.03  # never across the parting
    near = np.logical_and.accumulate(near, axis=1)
    weight = tight[:, None] * along**0.8 * near
    out = paths + weight[..., None] * (paths[guide] - paths)
    # all strands of a lock use the frame of its centre
    tangent = _unit(np.gradient(paths[guides], axis=1))
    across = _unit(np.cross(tangent, normals[guides][:, None] + 1e-3))
    binormal = np.cross(tangent, across)
    across, binormal = across[lock], binormal[lock]
    phase = _lock_phases(groom, paths[guides, 0], rng)[lock] + 0.15 * rng.normal(size=count)
    pitch = groom.wave_pitch * np.exp(0.06 * rng.normal(size=len(guides)).clip(-2, 2))[lock]
    radius = groom.wave_radius * np.exp(0.25 * rng.normal(size=len(guides)).clip(-2, 2))[lock]
    angle = phase[:, None] + 2 * np.pi * s[None] / pitch[:, None]
    size = (radius[:, None] * (1 - np.exp(-s / 0.02))[None])[..., None]
    wave = across * np.cos(angle)[..., None] + groom.helix * binormal * np.sin(angle)[..., None]
    wander = rng.normal(size=(count, 1, 3)) * groom.frizz * (along**1.5)[..., None]
    return out + size * wave + wander


def _lock_phases(groom: Groom, roots: Array, rng: np.random.Generator) -> Array:
    """Phases of the locks at `roots (G, 3)`, coherent for waves, random for ringlets."""
    waves = rng.normal(size=(4, 3)) * 18.0
    smooth = np.sin(roots @ waves.T + rng.uniform(0, 2 * np.pi, 4)).sum(axis=1)
    spread = 0.4 + (np.pi - 0.4) * groom.helix**2
    return np.asarray(1.2 * smooth + spread * rng.uniform(-1, 1, len(roots)))


def _push_out(paths: Array, field: HeadField) -> Array:
    """Points moved out of the head along the field, with clearance that grows from the root."""
    count, steps, _ = paths.shape
    clear = np.minimum(np.arange(steps) * 0.0004, 0.0015)
    flat = paths.reshape(-1, 3)
    for _ in range(3):
        distance, out = field(flat)
        short = np.maximum(np.tile(clear, count) - distance, 0)
        flat = flat + short[:, None] * out
    return flat.reshape(count, steps, 3)


def _nearest(candidates: Array, points: Array) -> Ints:
    return np.asarray(cKDTree(candidates).query(points)[1], dtype=np.int64)


def _unit(v: Array) -> Array:
    return np.asarray(v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12))

"""glTF: hair cards for engines, ribbons with a texture of the strands of a clump.

A card follows the clump's mean, as wide as the clump and facing away from the head; each has a tile
of the texture. Three levels of detail (MSFT_lod) have a quarter of the cards of the one before.
glTF is y up, in metres; the face looks along +z.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from appearance.export.glb import Glb
from appearance.export.groom import Groom, clumps, shapes
from reconstruction import Mesh
from reconstruction.arrays import Array, Floats, Ints
from reconstruction.geometry.strands import unit_or_zero

SEGMENTS = (12, 8, 5)
"""Quads along a card, level by level."""
TILE = (32, 256)
"""Pixels of a card's texture, across and along."""
ROW = 64
"""Tiles in a row of the texture."""
WIDE = 2.0
"""Half width of a card, in standard deviations of its clump."""
STRAIGHT = 1e-3
"""Sine of the angle to the head's normal below which a card's side is undetermined."""
Z_UP_TO_Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


@dataclass(frozen=True, eq=False)
class Cards:
    """Ribbons: the middle line `(C, K, 3)`, the way across and the normal, unit vectors of the same
    shape, half the width `(C, K)`, metres; the clump of each strand `(S,)`."""

    middle: Array
    across: Array
    normal: Array
    half: Array
    clump: Ints


def export_gltf(groom: Groom, path: Path, count: int, seed: int = 0) -> None:
    """Write a `.glb`: nodes `hair_lod0`, `hair_lod1`, … of `count`, `count` / 4, … cards; `head`.

    Colours are those of dense hair. Raises `ValueError` where there are no strands.
    """
    if not len(groom.strands):
        raise ValueError(f"{path}: there are no strands to make cards of")
    glb = Glb()
    colour = groom.colour(groom.looked_up[0]).astype(float)
    levels: list[int] = []
    for level, segments in enumerate(SEGMENTS):
        cards = make_cards(groom, max(count // 4**level, 1), segments, seed)
        texture = draw_cards(groom, cards, colour)
        material = glb.hair_material(f"hair_lod{level}", texture)
        levels.append(glb.mesh(f"hair_lod{level}", *_geometry(cards), material=material))
    glb.levels(levels)
    if groom.head is not None:
        used, faces = np.unique(groom.head.faces, return_inverse=True)
        turned = Mesh(groom.head.vertices[used] @ Z_UP_TO_Y_UP.T, faces.reshape(-1, 3))
        normals = turned.vertex_normals()
        normals[~normals.any(axis=1)] = (0, 1, 0)  # of faces without area; glTF wants unit vectors
        skin = glb.skin_material(groom.skin)
        glb.root(glb.mesh("head", turned.vertices, normals, turned.faces, material=skin))
    glb.write(path)


def make_cards(groom: Groom, count: int, segments: int, seed: int) -> Cards:
    """Cards of `count` clumps (fewer where there are fewer shapes)."""
    _, clump = clumps(groom.strands, count, seed)
    points = shapes(groom.strands, segments + 1)
    size = np.bincount(clump)
    middle = np.stack([_means(clump, x, size) for x in points.reshape(len(points), -1).T], axis=1)
    middle = middle.reshape(len(size), segments + 1, 3)
    along = _unit(np.asarray(np.gradient(middle, axis=1)))
    along[~along.any(axis=2)] = (0, 0, 1)  # of strands without length
    centre = (
        groom.strands.points.mean(axis=0) if groom.head is None else groom.head.vertices.mean(0)
    )
    across = _across(along, middle - centre)
    normal = np.cross(across, along)
    aside = ((points - middle[clump]) * across[clump]).sum(axis=2)
    spread = np.sqrt(np.stack([_means(clump, x, size) for x in aside.T**2], axis=1))
    least = 2 * float(np.median(groom.strands.radius))
    return Cards(middle, across, normal, np.maximum(WIDE * spread, least), clump)


def _across(along: Array, outwards: Array) -> Array:
    """Unit vectors `(C, K, 3)` at right angles to both; where cards stand straight off the head,
    the way that the rest of the card has, or any."""
    across = np.cross(along, outwards)
    length = np.linalg.norm(across, axis=2, keepdims=True)
    clear = length > STRAIGHT * np.linalg.norm(outwards, axis=2, keepdims=True)
    rest = np.where(clear, across, 0).sum(axis=1)
    none = ~rest.any(axis=1)
    rest[none] = np.eye(3)[np.abs(along[none, 0]).argmin(axis=1)]
    beside = rest[:, None] - along * (along * rest[:, None]).sum(axis=2, keepdims=True)
    return _unit(np.where(clear, across, beside))


def _unit(vectors: Array) -> Array:
    return unit_or_zero(vectors.reshape(-1, 3)).reshape(vectors.shape)


def draw_cards(groom: Groom, cards: Cards, colour: Array) -> Ints:
    """The cards' strands as an sRGB image `(H, W, 4)` uint8, root at a tile's top, BGRA."""
    width, height = TILE
    count, k = cards.half.shape
    rows = -(-count // ROW)
    colours = np.zeros((rows * height, min(count, ROW) * width, 3), np.float32)
    alpha = np.zeros(colours.shape[:2], np.uint8)
    points = shapes(groom.strands, k)
    middle, half = cards.middle[cards.clump], cards.half[cards.clump]
    aside = ((points - middle) * cards.across[cards.clump]).sum(axis=2) / half
    x = (np.clip(aside, -0.95, 0.95) * 0.5 + 0.5) * (width - 1)
    y = np.broadcast_to(np.linspace(0, height - 1, k), x.shape)
    first = groom.strands.offsets[:-1]
    mean = np.add.reduceat(colour, first, axis=0) / np.diff(groom.strands.offsets)[:, None]
    pixel = 2 * np.median(cards.half) / width
    thick = max(1, round(2 * float(np.median(groom.strands.radius)) / pixel))
    places = np.stack([x, y], axis=-1)
    for s, card in enumerate(cards.clump):
        corner = np.array([card % ROW * width, card // ROW * height])
        line = np.round((places[s] + corner) * 16).astype(np.int32)[:, None]
        cv2.polylines(alpha, [line], False, 255, thick, cv2.LINE_AA, 4)
        cv2.polylines(colours, [line], False, mean[s].tolist(), thick + 2, cv2.LINE_8, 4)
    bare = colours.sum(axis=2) == 0
    colours[bare] = mean.mean(axis=0)  # what filtering mixes in at the edges
    srgb = np.where(colours <= 0.0031308, 12.92 * colours, 1.055 * colours ** (1 / 2.4) - 0.055)
    shown = np.round(255 * np.clip(srgb, 0, 1)).astype(np.uint8)
    return np.dstack([shown[..., ::-1], alpha])


def _geometry(cards: Cards) -> tuple[Array, Array, Ints, Floats]:
    """Vertices and normals `(V, 3)`, triangles `(F, 3)`, texture coordinates `(V, 2)`."""
    count, k = cards.half.shape
    sides = np.array([-1.0, 1.0])[:, None]
    offset = cards.across[:, :, None] * (cards.half[..., None] * sides[:, 0])[..., None]
    vertices = cards.middle[:, :, None] + offset
    normals = np.broadcast_to(cards.normal[:, :, None], vertices.shape)
    rows, columns = -(-count // ROW), min(count, ROW)
    card = np.arange(count)
    inside = (0.5 + 0.5 * (1 - 1 / TILE[0]) * sides[:, 0])[None, None]
    u = (card % ROW)[:, None, None] + np.broadcast_to(inside, (count, k, 2))
    v = (card // ROW)[:, None, None] + np.broadcast_to(np.linspace(0, 1, k)[None, :, None], u.shape)
    uv = np.stack([u / columns, v / rows], axis=-1).reshape(-1, 2).astype(np.float32)
    corner = (2 * k * card)[:, None] + 2 * np.arange(k - 1)
    a, b, c, d = corner, corner + 1, corner + 2, corner + 3
    faces = np.stack([a, b, c, b, d, c], axis=-1).reshape(-1, 3)
    turn = Z_UP_TO_Y_UP.T
    return vertices.reshape(-1, 3) @ turn, normals.reshape(-1, 3) @ turn, faces, uv


def _means(group: Ints, values: Array, size: Ints) -> Array:
    return np.bincount(group, values) / size

"""Interpolation weights of captured cameras and lights for a new one."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from scipy.spatial import ConvexHull

from reconstruction.arrays import AnyFloats, Array, Floats, Ints

RADIAL = 6
"""Neighbours of a light with radial weights, about as many as Photobooth's."""
KRIGED = 24
"""Neighbours of a light whose samples are kriged."""
SAME = 1e-3
"""Radians between the directions of equal lights."""


def camera_weights(directions: AnyFloats, towards: AnyFloats) -> Array:
    """Weights `(C,)`, of sum 1, of cameras in unit `directions (C, 3)` for the direction `towards`.

    Barycentric over the faces of the directions' convex hull (Photobooth §4.1); a direction outside
    of all triangles uses the nearest edge.
    """
    directions = np.asarray(directions, float)
    corners = _triangles(directions)
    best, weights = -np.inf, None
    for corner in corners:
        matrix = directions[corner].T
        if abs(np.linalg.det(matrix)) < 1e-9:
            continue
        inside = np.linalg.solve(matrix, towards)
        # the outer of a front and a back face
        if inside.min() >= -1e-9 and 1 / inside.sum() > best:
            best, weights = 1 / inside.sum(), inside
            chosen = corner
    out = np.zeros(len(directions))
    if weights is None:
        pairs = (sorted(p) for c in corners for p in combinations(map(int, c), 2))
        edges = {(i, j) for i, j in pairs}
        chosen, weights = _nearest_edge(directions, towards, sorted(edges))
    np.add.at(out, chosen, np.clip(weights, 0, None))
    return out / out.sum()


def light_weights(directions: AnyFloats, towards: AnyFloats) -> tuple[Ints, Floats]:
    """The nearest lights `(T, k)` to each direction `towards (T, 3)`, and weights `(T, k)`, sum 1.

    Unit `directions (L, 3)`. Radial weights of `RADIAL` lights (Photobooth §4.1): Franke and
    Little's ((R - d)/(R d))² of the angle d, R that of the next light.
    """
    cosine = np.clip(towards @ directions.T, -1, 1)
    count = min(RADIAL, len(directions))
    order = np.argsort(-cosine, axis=1, kind="stable")
    angle = np.arccos(np.take_along_axis(cosine, order[:, : count + 1], axis=1))
    near, order = angle[:, :count], order[:, :count]
    reach = angle[:, -1:] if len(directions) > count else np.full((len(towards), 1), 2 * np.pi)
    left = np.maximum(reach - near, 1e-6 * (reach + 1e-6))  # equal if all are equally far
    weight = (left / np.maximum(near, 1e-5)) ** 2
    return order, (weight / weight.sum(axis=1, keepdims=True)).astype(np.float32)


def kriging_weights(directions: AnyFloats, towards: AnyFloats) -> tuple[Ints, Floats]:
    """The lights `(k,)` near the direction `towards (3,)`, and weights of sum 1, some negative.

    Unit `directions (L, 3)`. Ordinary kriging by the angle as variogram, whose scale has no effect,
    of the `KRIGED` nearest; a light in the same direction alone.
    """
    angle = np.arccos(np.clip(directions @ towards, -1, 1))
    near = np.argsort(angle, kind="stable")[:KRIGED]
    if angle[near[0]] < SAME:
        return near[:1], np.ones(1, np.float32)
    count = len(near)
    system = np.ones((count + 1, count + 1))
    system[:count, :count] = np.arccos(np.clip(directions[near] @ directions[near].T, -1, 1))
    np.fill_diagonal(system, 0)
    weights = np.linalg.lstsq(system, np.append(angle[near], 1), rcond=None)[0][:count]
    return near, (weights / weights.sum()).astype(np.float32)


def _triangles(directions: AnyFloats) -> Ints:
    """Triangles `(F, 3)` of the directions' hull; degenerate for one or two cameras."""
    if len(directions) <= 3:
        return np.arange(3)[None] % len(directions)
    return np.asarray(ConvexHull(directions, qhull_options="QJ").simplices)


def _nearest_edge(
    directions: AnyFloats, towards: AnyFloats, edges: list[tuple[int, int]]
) -> tuple[list[int], Array]:
    """The ends of the arc nearest to `towards`, and their weights."""
    found = []
    for i, j in edges:
        ends = directions[[i, j]].T
        weights = np.clip(np.linalg.lstsq(ends, towards, rcond=None)[0], 0, None)
        if not weights.any() or weights.min() == 0:
            weights = np.eye(2)[int(np.argmax(towards @ ends))]
        point = ends @ weights
        found.append((-float(towards @ point / np.linalg.norm(point)), [i, j], weights))
    _, chosen, weights = min(found, key=lambda x: x[0])
    return chosen, weights

"""The pose of a head: a similarity between a mesh and points, by robust ICP.

Point to plane, closest points by KD-tree, Tukey's weights on the distances. (Chen and Medioni 1992;
Zinßer, Schmidt, Niemann 2005 for the scale.)
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from skimage.transform import SimilarityTransform

from reconstruction.arrays import Array, Ints

MOTIONS = ("turn x", "turn y", "turn z", "scale", "shift x", "shift y", "shift z")
"""The motions of a similarity, in the order of every `(7,)` here."""

_YAWS = 12
_COARSE = 300
_ABOUT = np.radians([-30.0, 0.0, 30.0])


@dataclass(frozen=True, eq=False)
class SurfaceSamples:
    """Samples of a mesh to match with: `points (M, 3)`, unit `normals (M, 3)`, outward."""

    points: Array
    normals: Array

    _tree: cKDTree = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_tree", cKDTree(self.points))

    def nearest(self, points: Array, limit: float) -> tuple[Array, Ints]:
        """Distances `(N,)` up to `limit`, and sample indices `(N,)`, arbitrary beyond it."""
        distance, index = self._tree.query(points, distance_upper_bound=limit)
        return np.minimum(distance, limit), np.where(np.isfinite(distance), index, 0)


@dataclass(frozen=True, eq=False)
class Pose:
    """`x -> scale * rotation @ x + translation` from the mesh's frame to the points'.

    `deviation (7,)` are standard deviations of `MOTIONS` (radians, share, metres), for independent
    points. `stiffness (7,)`, ascending, is the RMS change of distances per metre of motion along
    each principal motion; `weakest` names the first. `margin` is the relative excess cost of the
    next best pose (infinite if all starts converge to this one).
    """

    scale: float
    rotation: Array
    translation: Array
    deviation: Array
    stiffness: Array
    weakest: str
    margin: float = np.inf

    @property
    def placed(self) -> tuple[float, Array, Array]:
        """Scale, rotation `(3, 3)` and translation `(3,)`."""
        return self.scale, self.rotation, self.translation

    def __call__(self, points: Array) -> Array:
        """Points `(N, 3)` of the mesh's frame in the points' frame."""
        return self.scale * points @ self.rotation.T + self.translation

    def inverse(self, points: Array) -> Array:
        """Points `(N, 3)` of the points' frame in the mesh's frame."""
        return (points - self.translation) @ self.rotation / self.scale


def tukey(distance: Array, least: float) -> Array:
    """Tukey weights `(N,)`, 0 beyond three robust deviations (at least `least`)."""
    cut = max(3 * 1.4826 * float(np.median(distance)), least)
    return np.maximum(1 - (distance / cut) ** 2, 0) ** 2


def similarity(source: Array, target: Array) -> tuple[float, Array, Array]:
    """Least-squares scale, rotation and translation from `source (N, 3)` to `target (N, 3)`.

    Umeyama 1991. Raises `ValueError` for under three points or collinear points.
    """
    if source.shape != target.shape or len(source) < 3:
        raise ValueError(
            f"expected at least 3 pairs of landmarks, got {source.shape} and {target.shape}"
        )
    for side in (source, target):
        spans = np.linalg.svd(side - side.mean(axis=0), compute_uv=False)
        if spans[1] < 1e-3 * spans[0]:
            raise ValueError("the landmarks are collinear: they determine no rotation")
    found = SimilarityTransform.from_estimate(source, target)
    scale = float(found.scale)
    return scale, found.params[:3, :3] / scale, np.asarray(found.translation)


@dataclass(frozen=True, eq=False)
class PoseSearch:
    """Starts of a pose search.

    Without a `start` (scale, rotation `(3, 3)`, translation `(3,)`), twelve rotations about z (or
    `turn`, radians, and 30° to either side) at each of `scales` are tried on `_COARSE` points, with
    tops aligned. `scale_deviation` is the prior standard deviation of the log scale about the
    middle of `scales`, or None. `size` is the head's radius in the points' unit.
    """

    start: tuple[float, Array, Array] | None = None
    turn: float | None = None
    scales: tuple[float, ...] = (1.0,)
    scale_deviation: float | None = 0.1
    size: float = 0.1
    seed: int = 0


def find_pose(
    surface: SurfaceSamples,
    points: Array,
    normals: Array | None = None,
    search: PoseSearch = PoseSearch(),
) -> Pose:
    """The pose of `surface` on `points (N, 3)`, both roughly with z up.

    `normals (N, 3)` are outward and of unit length.
    """
    if search.start is not None:
        return _refine(surface, (points, normals), search.start, search, 60)
    turn, size = search.turn, search.size
    order = np.random.default_rng(search.seed).permutation(len(points))

    def some(count: int) -> tuple[Array, Array | None]:
        few = order[:count]
        return points[few], None if normals is None else normals[few]

    coarse, facing = some(_COARSE)
    yaws = np.arange(_YAWS) * 2 * np.pi / _YAWS if turn is None else turn + _ABOUT
    tries = []
    for scale, yaw in product(search.scales, yaws):
        rotation = Rotation.from_rotvec([0, 0, yaw]).as_matrix()
        moved = scale * surface.points @ rotation.T
        shift = np.median(coarse, axis=0) - np.median(moved, axis=0)
        shift[2] = np.percentile(coarse[:, 2], 85) - np.percentile(moved[:, 2], 85)
        pose = _refine(surface, (coarse, facing), (scale, rotation, shift), search, 20)
        tries.append((_cost(surface, pose, coarse, facing, size), pose))
    tries.sort(key=lambda t: t[0])
    distinct: list[Pose] = []
    for _, pose in tries:
        if all(_apart(pose, other) > np.radians(5) for other in distinct):
            distinct.append(pose)
    ends = []
    for t in distinct[:3]:
        p = _refine(surface, some(1000), t.placed, search, 60)
        ends.append((_cost(surface, p, *some(1000), size), p))
    p = min(ends, key=lambda end: end[0])[1]
    best = _refine(surface, (points, normals), p.placed, search, 60)
    others = [*(pose for _, pose in ends), *distinct[3:]]
    others = [p for p in others if turn is None and _apart(p, best) > np.radians(10)]
    return replace(best, margin=_margin(surface, best, others, points, normals, size))


def _margin(
    surface: SurfaceSamples,
    best: Pose,
    others: list[Pose],
    points: Array,
    normals: Array | None,
    size: float,
) -> float:
    """Relative excess cost of the next best pose, over the inliers of the best."""
    if not others:
        return np.inf
    distance = best.scale * surface.nearest(best.inverse(points), 0.5 * size / best.scale)[0]
    on = tukey(distance, 0.01 * size) > 0
    if normals is not None:
        normals = normals[on]
    own, *rest = (_cost(surface, p, points[on], normals, size) for p in (best, *others))
    return float(min(rest) / max(own, 1e-6) - 1)


def _apart(a: Pose, b: Pose) -> float:
    return float(Rotation.from_matrix(a.rotation @ b.rotation.T).magnitude())


def _cost(
    surface: SurfaceSamples, pose: Pose, points: Array, normals: Array | None, size: float
) -> float:
    """Mean squared distance, clipped at and in units of an eighth of the head's radius."""
    cut = 0.125 * size / pose.scale
    distance, index = surface.nearest(pose.inverse(points), cut)
    far = distance / cut
    if normals is not None:
        far[((surface.normals[index] @ pose.rotation.T) * normals).sum(axis=1) < 0] = 1
    return float((far**2).mean())


def _refine(
    surface: SurfaceSamples,
    cloud: tuple[Array, Array | None],
    start: tuple[float, Array, Array],
    search: PoseSearch,
    limit: int,
) -> Pose:
    """ICP on the points and normals of `cloud` from one start."""
    (points, normals), size, known = cloud, search.size, search.scale_deviation
    scale, rotation, translation = start
    middle = float(np.exp(np.mean(np.log(search.scales))))
    for _ in range(limit):
        there = (points - translation) @ rotation / scale
        distance, index = surface.nearest(there, size / scale)
        n = surface.normals[index] @ rotation.T
        x = scale * surface.points[index] @ rotation.T + translation
        weight = tukey(scale * distance, 0.01 * size)
        if normals is not None:
            weight = weight * ((n * normals).sum(axis=1) > 0.5)
        total = max(float(weight.sum()), 1e-9)
        center = weight @ x / total
        q = x - center
        # all motions in units of length: radius times angle or share
        radius = max(float(np.sqrt(weight @ (q**2).sum(axis=1) / total)), 1e-9)
        J = np.hstack([np.cross(q, n) / radius, (q * n).sum(axis=1)[:, None] / radius, n])
        r = (n * (points - x)).sum(axis=1)
        normal, right = (J.T * weight) @ J / total, (J.T * weight) @ r / total
        variance = float(weight @ r**2) / total
        stiffness, motions = np.linalg.eigh(normal)
        if known is not None:
            strength = max(variance, (1e-3 * size) ** 2) / (total * (known * radius) ** 2)
            normal[3, 3] += strength
            right[3] += strength * radius * np.log(middle / scale)
        values, vectors = np.linalg.eigh(normal)
        free = values > 1e-4 * values[-1]  # undetermined motions stay fixed
        step = vectors[:, free] @ (vectors[:, free].T @ right / values[free])
        step[:4] = np.clip(step[:4] / radius, -0.2, 0.2)
        turn, grow = Rotation.from_rotvec(step[:3]).as_matrix(), float(np.exp(step[3]))
        translation = grow * turn @ (translation - center) + center + step[4:]
        rotation, scale = turn @ rotation, scale * grow
        if radius * np.abs(step[:4]).max() + np.linalg.norm(step[4:]) < 1e-5 * size:
            break
    spread = np.full(7, np.inf)
    if free.all():
        spread = np.sqrt(variance * np.diag(vectors / values @ vectors.T) / total)
        spread[:4] /= radius
    first = int(np.abs(motions[:, 0]).argmax())
    stiffness = np.sqrt(np.maximum(stiffness, 0))
    return Pose(float(scale), rotation, translation, spread, stiffness, MOTIONS[first])

"""Fit of a head mesh to points: a pose, then a smooth deformation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from scipy.spatial import cKDTree

from reconstruction.arrays import AnyFloats, Array, Bools
from reconstruction.geometry.closest_point import ClosestPoint
from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.mesh_queries import surface_samples
from reconstruction.head.generic import generic_head
from reconstruction.head.pose import (
    MOTIONS,
    Pose,
    PoseSearch,
    SurfaceSamples,
    find_pose,
    similarity,
    tukey,
)
from reconstruction.head.shape import deform

FEWEST = 10  # points: a pose has seven unknowns

Part = Literal["head", "above chin", "scalp"]
_SCALES = (0.7, 1.4)
_CROWN_TO_CHIN = 0.24
_INWARD = 0.1
"""Normals point inwards if their mean cosine to the direction from the points' middle is below
-0.1: outward normals of any part 16 cm wide have at least 0.26, 10 cm wide -0.01."""
_UNITS = {10: "decimetres", 39.37: "inches", 100: "centimetres", 1000: "millimetres"}


class HeadFitError(ValueError):
    """No head can be fitted; the message says why and what to do."""


@dataclass(frozen=True)
class Distances:
    """Distances between points and mesh, in the points' unit: medians, 95th percentiles, RMS.

    `to_mesh_*` from the inliers to the mesh, `to_points_*` from the matched part of the mesh to the
    nearest point, which includes the points' spacing.
    """

    to_mesh_rms: float
    to_mesh_median: float
    to_mesh_p95: float
    to_points_median: float
    to_points_p95: float


@dataclass(frozen=True, eq=False)
class HeadFit:
    """The template fitted to points by a `pose` and a deformation (`mesh`, with its scalp).

    `posed` and `deformed` are the distances before and after the deformation; `outliers (N,)` are
    points not used; `folded` is the number of faces that turned over.
    """

    mesh: Mesh
    pose: Pose
    posed: Distances
    deformed: Distances
    outliers: Bools
    folded: int
    warnings: tuple[str, ...]

    def figures(self) -> dict[str, Any]:
        """Figures of the fit, JSON-ready."""
        deviation = [float(d) if np.isfinite(d) else None for d in self.pose.deviation]
        return {
            "scale": self.pose.scale,
            "posed": vars(self.posed),
            "deformed": vars(self.deformed),
            "outlier_share": float(self.outliers.mean()),
            "folded_faces": self.folded,
            "pose_deviation": dict(zip(MOTIONS, deviation, strict=True)),
            "stiffness": self.pose.stiffness.tolist(),
            "weakest": self.pose.weakest,
            "margin": self.pose.margin if np.isfinite(self.pose.margin) else None,
        }


@dataclass(frozen=True, eq=False)
class HeadHints:
    """Prior knowledge of points on a head.

    `part` of the template that they lie on; metres unless `any_unit`. `landmarks` are at least
    three points `(L, 3)` on the template and the same ones `(L, 3)` among the points; without them
    all rotations about z are tried, or those near `turn` (radians, 0 faces −y). `guides` are points
    and normals `(G, 3)` roughly on the head, used for the pose only.
    """

    part: Part = "head"
    landmarks: tuple[AnyFloats, AnyFloats] | None = None
    turn: float | None = None
    guides: tuple[AnyFloats, AnyFloats] | None = None
    any_unit: bool = False


def fit_head(
    points: AnyFloats,
    normals: AnyFloats | None = None,
    template: Mesh | None = None,
    hints: HeadHints = HeadHints(),
    *,
    seed: int = 0,
) -> HeadFit:
    """Fit `template` (default: the generic head) to `points (N, 3)`, both with z up.

    `normals (N, 3)` are outward and of unit length, if known; about 40 % of the points may be
    outliers. Raises `HeadFitError`.
    """
    part, landmarks, any_unit = hints.part, hints.landmarks, hints.any_unit
    template = generic_head() if template is None else template
    at: Array = np.asarray(points, np.float64).reshape(-1, 3)
    facing = None if normals is None else np.asarray(normals, np.float64).reshape(-1, 3)
    faces = _faces(template, part)
    extent = float(np.ptp(template.vertices, axis=0).max())
    places, own, face = surface_samples(template, extent / 35)
    surface = SurfaceSamples(places[faces[face]], own[faces[face]])
    ratio = _ratio(at, facing, surface.points)
    if not any_unit:
        _require_unit(ratio, part)
    middle = ratio if any_unit else 1.0
    size = middle * _spread(surface.points)
    start = None
    if landmarks is not None:
        try:
            start = similarity(*(np.asarray(side, float) for side in landmarks))
        except ValueError as error:
            raise HeadFitError(str(error)) from error
    search = PoseSearch(
        start=start,
        turn=hints.turn,
        scales=(0.7 * middle, middle, 1.4 * middle) if any_unit else (1.0,),
        scale_deviation=None if any_unit else 0.1,
        size=size,
        seed=seed,
    )
    pose = find_pose(surface, *_with(at, facing, hints.guides), search)
    if not any_unit and not _SCALES[0] < pose.scale < _SCALES[1]:
        raise HeadFitError(
            f"the fitted head has {pose.scale:.2f} times the template's size, expected "
            f"{_SCALES[0]} to {_SCALES[1]}: check that the points are on a head and in metres"
        )
    posed = Mesh(pose(template.vertices), template.faces, template.scalp)
    mesh = deform(posed, faces, at, facing, size)
    before, _ = _distances(posed, faces, at, size)
    after, outliers = _distances(mesh, faces, at, size)
    folded = int(((posed.face_normals() * mesh.face_normals()).sum(axis=1) < 0).sum())
    return HeadFit(mesh, pose, before, after, outliers, folded, _warnings(pose, outliers))


def mark_scalp(mesh: Mesh, *, seed: int = 0) -> tuple[Mesh, HeadFit]:
    """A head mesh (any unit, z up, no body) with the generic head's scalp marked on it.

    The generic head is fitted to the mesh; faces near its scalp with similar normals (not the backs
    of ears) are scalp. Raises `HeadFitError`.
    """
    spacing = float(np.ptp(mesh.vertices, axis=0).max()) / 80
    places, normals, _ = surface_samples(mesh, spacing)
    few = np.random.default_rng(seed).permutation(len(places))[:3000]
    fit = fit_head(places[few], normals[few], hints=HeadHints(any_unit=True), seed=seed)
    assert fit.mesh.scalp is not None
    nearest = ClosestPoint(fit.mesh, spacing)
    face, _, distance = nearest(mesh.vertices[mesh.faces].mean(axis=1))
    alike = (mesh.face_normals() * fit.mesh.face_normals()[face]).sum(axis=1) > 0.5
    scalp = fit.mesh.scalp[face] & alike & (distance < 2 * spacing)
    return Mesh(mesh.vertices, mesh.faces, scalp), fit


def _faces(template: Mesh, part: str) -> Bools:
    if part not in get_args(Part):
        raise ValueError(f"part must be one of {get_args(Part)}, got {part!r}")
    if part == "above chin":
        height = template.vertices[template.faces][:, :, 2].min(axis=1)
        return np.asarray(height > template.vertices[:, 2].max() - _CROWN_TO_CHIN)
    if part == "head":
        return np.ones(len(template.faces), bool)
    if template.scalp is None or not template.scalp.any():
        raise HeadFitError(
            "the template marks no scalp (a group or material named 'scalp' in its OBJ): "
            "fit the whole head, or mark it with 'hairstage head mark'"
        )
    return template.scalp


def _with(
    points: Array, normals: Array | None, guides: tuple[AnyFloats, AnyFloats] | None
) -> tuple[Array, Array | None]:
    if guides is None:
        return points, normals
    every = np.concatenate([points, np.asarray(guides[0], np.float64)])
    if normals is None:
        return every, None
    return every, np.concatenate([normals, np.asarray(guides[1], np.float64)])


def _spread(points: Array) -> float:
    """Median distance from the median: a robust size."""
    return float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))


def _ratio(points: Array, normals: Array | None, template: Array) -> float:
    """The points' spread relative to the template's; raises `HeadFitError` for invalid points."""
    if len(points) < FEWEST:
        raise HeadFitError(f"{len(points)} points, at least {FEWEST} are needed to fit a head")
    if normals is not None and normals.shape != points.shape:
        raise HeadFitError(f"{len(points)} points but {len(normals)} normals")
    for what, array in (("points", points), ("normals", normals)):
        if array is not None and not np.isfinite(array).all():
            bad = np.flatnonzero(~np.isfinite(array).all(axis=1))
            raise HeadFitError(f"{len(bad)} {what} are not finite, the first is number {bad[0]}")
    out = points - points.mean(axis=0)
    spans = np.linalg.svd(out, compute_uv=False)
    if spans[1] <= 1e-6 * max(spans[0], 1e-12):
        raise HeadFitError("the points coincide or are collinear: they determine no head")
    if normals is not None and (out * normals).sum() < -_INWARD * np.linalg.norm(out, axis=1).sum():
        raise HeadFitError(
            "the normals point into the head: reverse them (for a mesh, its faces), or provide "
            "points without normals"
        )
    return _spread(points) / _spread(template)


def _require_unit(ratio: float, part: str) -> None:
    smallest = 0.25 if part == "head" else 0.1  # may be a patch of scalp
    if smallest < ratio < 4:
        return
    if ratio >= 4:
        factor, unit = min(_UNITS.items(), key=lambda u: abs(np.log(ratio / u[0])))
        raise HeadFitError(
            f"the points' extent is {ratio:.3g} times that of a head in metres: they seem to be in "
            f"{unit}; multiply them by {1 / factor:.4g}"
        )
    raise HeadFitError(
        f"the points' extent is only {ratio:.3g} times that of a head in metres: check their unit "
        "and that they are on a head"
    )


def _distances(mesh: Mesh, faces: Bools, points: Array, size: float) -> tuple[Distances, Bools]:
    distance = ClosestPoint(mesh, 0.08 * size, faces)(points)[2]
    outliers = tukey(distance, 0.03 * size) == 0
    places, _, face = surface_samples(mesh, 0.08 * size)
    back = cKDTree(points[~outliers]).query(places[faces[face]])[0]
    used = distance[~outliers]
    quantiles = [np.percentile(d, q) for d in (used, back) for q in (50, 95)]
    rms = float(np.sqrt(np.mean(used**2)))
    return Distances(rms, *(float(q) for q in quantiles)), outliers


def _warnings(pose: Pose, outliers: Bools) -> tuple[str, ...]:
    out = []
    if pose.stiffness[0] < 0.03:
        out.append(
            f"the points hardly determine the head's pose: a millimetre along the weakest motion, "
            f"{pose.weakest}, changes distances by {pose.stiffness[0]:.2g} mm"
        )
    if pose.margin < 0.2:
        out.append(
            f"another pose fits nearly as well (its cost is {pose.margin:.0%} higher): provide "
            "landmarks"
        )
    if outliers.mean() > 0.4:
        out.append(f"{outliers.mean():.0%} of the points are not on the head")
    return tuple(out)

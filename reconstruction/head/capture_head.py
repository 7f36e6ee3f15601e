"""The head of a capture that has none: a template laid under digitised or reconstructed points."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from reconstruction.arrays import Array, Bools, Ints
from reconstruction.capture.folder import Capture, CaptureError
from reconstruction.containment import inside
from reconstruction.files.points import read_points
from reconstruction.geometry.mesh import Mesh, read_obj
from reconstruction.geometry.voxels import VoxelGrid
from reconstruction.head.fit import HeadFit, HeadFitError, HeadHints, fit_head
from reconstruction.head.generic import generic_head
from reconstruction.head.lit_skin import (
    FEWEST_LIGHTS,
    FEWEST_PIXELS,
    first_depth,
    lit_skin,
)
from reconstruction.head.scalp_map import ScalpMap
from reconstruction.head.template import template
from reconstruction.light_planes.point_cloud import PointCloud
from reconstruction.mask_geometry import distance_to
from reconstruction.masks import MaskedCapture
from reconstruction.report.report import Stage
from reconstruction.tangents.reflection import surface_normals

FEWEST_SKIN = 300  # cells with a point of skin under which a head is not guessed from them
_CELL = 3e-3
_INSIDE = 4e-3
_AMBIGUOUS = 0.2
_HAIR = 0.015  # metres of hair over the scalp, roughly
_CROWN, _HEIGHT, _RADIUS = 0.12, 0.22, 0.14
"""Metres: a crown that shows where the head is; from hair to mouth or chin; half a head's depth."""


@dataclass(frozen=True, eq=False)
class HeadPoints:
    """Points `(N, 3)` of a head, metres, outward unit `normals (N, 3)` where known.

    `source` says who gave them, `hints` what else is known of them.
    """

    points: Array
    normals: Array | None
    hints: HeadHints
    source: str


@dataclass(frozen=True, eq=False)
class FittedHead:
    """A head under points, and the flat map of its scalp, which it has from its template.

    None where the template's scalp cannot be laid flat.
    """

    mesh: Mesh
    scalp_map: ScalpMap | None


def digitised_points(capture: Capture, path: str | Path | None) -> HeadPoints | None:
    """The scalp points of the user's file, or else of `scalp.obj` in the capture, or else None.

    Raises `ValueError` naming the file where it cannot be read.
    """
    file = Path(path) if path is not None else inside(capture.path, "scalp.obj")
    if path is None and not file.is_file():
        return None
    points, normals = read_points(file)
    return HeadPoints(*_thinned(points, normals), HeadHints(part="scalp"), file.name)


def skin_points(masked: MaskedCapture, cloud: PointCloud) -> HeadPoints:
    """Reconstructed points that the mask of the camera that saw them calls skin.

    Points with a neighbour that some mask calls hair within a cell's size are left out: a fringe's
    edge is no skin. So is what lies too low or too far out to be the face of the head that the
    highest points are of: neck and shoulders. The head is taken to face the side of the bare skin,
    and to lie some way under the hair of its crown: skin alone leaves its size open. Raises
    `CaptureError` where too few are left to fit a head to.
    """
    capture, masks = masked.capture, masked.masks
    if not len(cloud):
        raise CaptureError(
            f"{capture.path}: no head.obj, and no sweep to find a head by: give head.obj or "
            "scalp.obj, or take the method auto, which looks for a face under single lights"
        )
    skin, hair = np.zeros((2, len(cloud)), bool)
    for index, name in enumerate(cloud.cameras):
        if name not in masks:
            continue
        mine = np.flatnonzero(cloud.camera == index)
        seen, x, y, _ = capture.rig.camera(name).pixels_of(cloud.points[mine])
        skin[mine[seen]] = masks[name].skin[y[seen], x[seen]]
        hair[mine[seen]] = masks[name].hair[y[seen], x[seen]]
    if skin.any() and hair.any():
        near = cKDTree(cloud.points[hair]).query(cloud.points[skin])[0] < _CELL
        skin[np.flatnonzero(skin)[near]] = False
    face, middle = _head_region(cloud.points)
    skin &= face
    facing = surface_normals(cloud.points[skin], cloud.view[skin], 24)
    points, normals = _thinned(cloud.points[skin], facing)
    if len(points) < FEWEST_SKIN:
        raise CaptureError(
            f"{capture.path}: no head.obj, and only {len(points)} cells of {_CELL * 1e3:g} mm hold "
            f"triangulated points of bare skin, at least {FEWEST_SKIN} are needed to fit a head: "
            "strands need a scalp to be rooted on; give head.obj, or digitised scalp points as "
            "scalp.obj in the capture or by the option scalp_points"
        )
    x, y = points[:, :2].mean(axis=0) - middle
    turn = float(np.arctan2(x, -y))
    under = hair & face
    guides = _under_the_hair(cloud.points[under], cloud.view[under], len(points))
    hints = HeadHints(part="above chin", turn=turn, guides=guides)
    return HeadPoints(points, normals, hints, "reconstructed skin")


def lit_skin_points(masked: MaskedCapture, hull: VoxelGrid) -> HeadPoints:
    """Points on the bare skin of a face, whose shape single lights tell: see `lit_skin`.

    Of the camera that shows most of it. `hull` is the subject's; the head lies some way under the
    crown's hair, as in `skin_points`. Raises `CaptureError` where no camera shows enough.
    """
    capture, cameras = masked.capture, masked.cameras
    lowest = float(np.percentile(hull.centers()[:, 2], 99.5)) - _HEIGHT
    largest = sorted(cameras, key=lambda c: int(masked.masks[c.name].skin.sum()), reverse=True)
    found = [lit_skin(capture, c, masked.masks[c.name].skin, hull, lowest) for c in largest[:3]]
    faces = [f for f in found if f is not None]
    if not faces:
        raise CaptureError(
            f"{capture.path}: no camera shows {FEWEST_PIXELS} pixels of skin in one piece under "
            f"{FEWEST_LIGHTS} single lights"
        )
    face = max(faces, key=lambda f: len(f.points))
    crown, view = [], []
    for camera in cameras:
        depth = first_depth(camera, hull)
        y, x = np.nonzero(masked.masks[camera.name].hair & np.isfinite(depth))
        rays = camera.rays(np.stack([x, y], axis=1))
        crown.append(camera.center + rays * (depth[y, x] / (rays @ camera.R[2]))[:, None])
        view.append(-rays)
    hair, towards = np.concatenate(crown), np.concatenate(view)
    near, middle = _head_region(np.concatenate([hair, face.points]))
    skin = near[len(hair) :]
    points, normals = _thinned(face.points[skin], face.normals[skin])
    if len(points) < FEWEST_SKIN:
        raise CaptureError(f"{capture.path}: {face.camera} shows too little skin of the head")
    x, y = points[:, :2].mean(axis=0) - middle
    guides = _under_the_hair(hair[near[: len(hair)]], towards[near[: len(hair)]], len(points))
    hints = HeadHints(part="above chin", turn=float(np.arctan2(x, -y)), guides=guides)
    return HeadPoints(points, normals, hints, f"skin under single lights, {face.camera}")


def fit_capture_head(
    points: HeadPoints,
    head_mesh: str | Path | None,
    stage: Stage,
    *,
    cloud: PointCloud | None = None,
    seed: int = 0,
) -> FittedHead:
    """Fit the generic head, or the user's `head_mesh`, under `points`.

    `head_mesh` is an OBJ with z up and may mark its scalp. Points that leave the turn about z open
    are taken to be of a head that faces −y, as heads do by convention, with a warning. Of a
    `cloud`, the share that lies inside the head is reported. Raises `CaptureError`.
    """
    own = None if head_mesh is None else read_obj(head_mesh)
    try:
        shape, marked = (generic_head(), None) if own is None else template(own, seed=seed)
        for warning in marked.warnings if marked is not None else ():
            stage.warn(f"{head_mesh}: its scalp: {warning}")

        def fitted(turn: float | None) -> HeadFit:
            hints = replace(points.hints, turn=turn)
            return fit_head(points.points, points.normals, shape, hints, seed=seed)

        fit = fitted(points.hints.turn)
        if fit.pose.margin < _AMBIGUOUS:
            stage.warn(
                "the points fit a head that faces another way nearly as well (its cost is "
                f"{fit.pose.margin:.0%} higher): it is taken to face −y"
            )
            fit = fitted(0.0)
    except HeadFitError as error:
        raise CaptureError(f"no head fits the points of {points.source}: {error}") from error
    _report(points, fit, "generic head" if own is None else Path(str(head_mesh)).name, stage)
    if cloud is not None and len(cloud):
        share = float((distance_to(fit.mesh, cloud.points) < -_INSIDE).mean())
        stage.figures["cloud_inside_share"] = share
        if share > 0.1:
            stage.warn(
                f"{share:.0%} of the triangulated points lie over {_INSIDE * 1e3:g} mm inside the "
                "fitted head: it is too large or displaced; digitised scalp points would settle it"
            )
    try:
        return FittedHead(fit.mesh, ScalpMap.of(shape).on(fit.mesh))
    except ValueError:  # it folds, which is said where the map is written
        return FittedHead(fit.mesh, None)


def _report(points: HeadPoints, fit: HeadFit, name: str, stage: Stage) -> None:
    for warning in fit.warnings:
        stage.warn(warning)
    stage.figures |= {
        "points": len(points.points),
        "source": points.source,
        "template": name,
        "rms_mm": fit.deformed.to_mesh_rms * 1e3,
        "posed_rms_mm": fit.posed.to_mesh_rms * 1e3,
        "used_share": 1 - float(fit.outliers.mean()),
        "fit": fit.figures(),
    }


def _head_region(points: Array) -> tuple[Bools, Array]:
    """Which of the points `(N, 3)`, hair and all, can be of the head that the highest are of.

    Also its middle `(2,)` on the ground.
    """
    if not len(points):
        return np.zeros(0, bool), np.zeros(2)
    top = np.percentile(points[:, 2], 99.5)
    upper = points[points[:, 2] > top - _CROWN][:, :2]
    middle = np.percentile(upper, [2, 98], axis=0).mean(axis=0)
    beside = np.linalg.norm(points[:, :2] - middle, axis=1)
    return (points[:, 2] > top - _HEIGHT) & (beside < _RADIUS), middle


def _under_the_hair(points: Array, view: Array, most: int) -> tuple[Array, Array] | None:
    """About where the scalp is `(G, 3)` under the crown's hair, with its normals.

    Of `points (N, 3)` on hair that were seen from the directions `view (N, 3)`. No more than
    `most`: they weigh no more than the skin.
    """
    if not len(points):
        return None
    crown = points[:, 2] > np.percentile(points[:, 2], 99.5) - _CROWN
    points, view = points[crown], view[crown]
    first = _one_a_cell(points)
    normals = surface_normals(points[first], view[first])
    guides = points[first] - _HAIR * normals
    few = np.random.default_rng(0).permutation(len(guides))[:most]
    return guides[few], normals[few]


def _thinned(points: Array, normals: Array | None) -> tuple[Array, Array | None]:
    """One of the points in each cell, so that dense places do not outweigh the others."""
    first = _one_a_cell(points)
    return points[first], None if normals is None else normals[first]


def _one_a_cell(points: Array) -> Ints:
    cell = np.floor(points / _CELL).astype(np.int64)
    return np.sort(np.unique(cell, axis=0, return_index=True)[1])

"""The head of a capture without a mesh: a template fitted to digitised or reconstructed points."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from reconstruction.arrays import Array, Bools, Ints
from reconstruction.capture.folder import Capture
from reconstruction.capture.records import CaptureError
from reconstruction.containment import inside
from reconstruction.files.points import read_points
from reconstruction.geometry.mesh import Mesh, read_obj
from reconstruction.geometry.placement import to_z_up
from reconstruction.geometry.voxels import VoxelGrid
from reconstruction.head.fit import HeadFit, HeadFitError, HeadHints, fit_head
from reconstruction.head.generic import generic_head
from reconstruction.head.lit_skin import FEWEST_LIGHTS, FEWEST_PIXELS, lit_skin
from reconstruction.head.scalp_map import ScalpMap
from reconstruction.head.template import template
from reconstruction.images.visual_hull import first_depth
from reconstruction.light_planes.point_cloud import PointCloud
from reconstruction.mask_geometry import distance_to
from reconstruction.masks import MaskedCapture
from reconstruction.report.report import Stage
from reconstruction.tangents.reflection import surface_normals

FEWEST_SKIN = 300  # cells with a skin point needed to fit a head
_CELL = 3e-3
_INSIDE = 4e-3
_AMBIGUOUS = 0.2
_HAIR = 0.015  # metres: approximate thickness of the hair on the scalp
_CROWN, _HEIGHT, _RADIUS = 0.12, 0.22, 0.14
"""Metres: height of the crown, from the hair to mouth or chin, and half a head's depth."""


@dataclass(frozen=True, eq=False)
class HeadPoints:
    """Points `(N, 3)` of a head, metres, with outward unit `normals (N, 3)` if known.

    `source` names their origin for messages, `hints` is prior knowledge.
    """

    points: Array
    normals: Array | None
    hints: HeadHints
    source: str


@dataclass(frozen=True, eq=False)
class FittedHead:
    """A fitted head, and the scalp map of its template, None if that map folds."""

    mesh: Mesh
    scalp_map: ScalpMap | None


def digitised_points(capture: Capture, path: str | Path | None) -> HeadPoints | None:
    """The scalp points in the user's file, else in the capture's `scalp.obj`, else None.

    Raises `ValueError` naming a file that cannot be read.
    """
    file = Path(path) if path is not None else inside(capture.path, "scalp.obj")
    if path is None and not file.is_file():
        return None
    points, normals = read_points(file)
    if path is not None and (world := capture.world) is not None:
        points = world.to_stage(points)
        normals = None if normals is None else normals @ to_z_up(world.up).T
    return HeadPoints(*_thinned(points, normals), HeadHints(part="scalp"), file.name)


def skin_points(masked: MaskedCapture, cloud: PointCloud) -> HeadPoints:
    """Triangulated points that are skin in the mask of their camera.

    Points within `_CELL` of a hair point are excluded, and so are points too low or too far out for
    the face (neck, shoulders). The head is assumed to face the side of the bare skin; points
    `_HAIR` under the hair of the crown constrain its size. Raises `CaptureError` if too few points
    remain.
    """
    capture, masks = masked.capture, masked.masks
    if not len(cloud):
        raise CaptureError(
            f"{capture.path}: no head.obj, nor a sweep to fit a head to: provide head.obj or "
            "scalp.obj, or use the method auto, which fits a head to the face under single lights"
        )
    skin, hair = np.zeros((2, len(cloud)), bool)
    for index, name in enumerate(cloud.cameras):
        if name not in masks:
            continue
        mine = np.flatnonzero(cloud.camera == index)
        inside, x, y, _ = capture.rig.camera(name).pixels_of(cloud.points[mine])
        skin[mine[inside]] = masks[name].skin[y[inside], x[inside]]
        hair[mine[inside]] = masks[name].hair[y[inside], x[inside]]
    if skin.any() and hair.any():
        near = cKDTree(cloud.points[hair]).query(cloud.points[skin])[0] < _CELL
        skin[np.flatnonzero(skin)[near]] = False
    face, middle = _head_region(cloud.points)
    skin &= face
    facing = surface_normals(cloud.points[skin], cloud.view[skin], 24)
    points, normals = _thinned(cloud.points[skin], facing)
    if len(points) < FEWEST_SKIN:
        raise CaptureError(
            f"{capture.path}: no head.obj, and bare skin was triangulated in only {len(points)} "
            f"cells of {_CELL * 1e3:g} mm, expected {FEWEST_SKIN} or more to fit a head: provide "
            "head.obj, or digitised scalp points as scalp.obj or by the option scalp_points"
        )
    x, y = points[:, :2].mean(axis=0) - middle
    turn = float(np.arctan2(x, -y))
    under = hair & face
    guides = _under_the_hair(cloud.points[under], cloud.view[under], len(points))
    hints = HeadHints(part="above chin", turn=turn, guides=guides)
    return HeadPoints(points, normals, hints, "reconstructed skin")


def lit_skin_points(masked: MaskedCapture, hull: VoxelGrid) -> HeadPoints:
    """Points on the bare skin of a face by photometric stereo (`lit_skin`).

    From the camera with most skin. `hull` is the subject's; the crown constrains the head as in
    `skin_points`. Raises `CaptureError` if no camera shows enough skin.
    """
    capture, cameras = masked.capture, masked.cameras
    lowest = float(np.percentile(hull.centers()[:, 2], 99.5)) - _HEIGHT
    largest = sorted(cameras, key=lambda c: int(masked.masks[c.name].skin.sum()), reverse=True)
    found = [lit_skin(capture, c, masked.masks[c.name].skin, hull, lowest) for c in largest[:3]]
    faces = [f for f in found if f is not None]
    if not faces:
        raise CaptureError(
            f"{capture.path}: no camera shows {FEWEST_PIXELS} connected pixels of skin under "
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
    """Fit the generic head, or the user's `head_mesh` (OBJ, z up), to `points`.

    If the points do not determine the rotation about z, the head is assumed to face −y, with a
    warning. The share of `cloud` inside the head is reported. Raises `CaptureError`.
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
                "the rotation of the head about z is ambiguous (the cost of another one is "
                f"{fit.pose.margin:.0%} higher): it is assumed to face −y"
            )
            fit = fitted(0.0)
    except HeadFitError as error:
        raise CaptureError(f"no head could be fitted to {points.source}: {error}") from error
    _report(points, fit, "generic head" if own is None else Path(str(head_mesh)).name, stage)
    if cloud is not None and len(cloud):
        share = float((distance_to(fit.mesh, cloud.points) < -_INSIDE).mean())
        stage.figures["cloud_inside_share"] = share
        if share > 0.1:
            stage.warn(
                f"{share:.0%} of the triangulated points lie over {_INSIDE * 1e3:g} mm inside the "
                "fitted head: it is too large or displaced; provide digitised scalp points"
            )
    try:
        return FittedHead(fit.mesh, ScalpMap.of(shape).on(fit.mesh))
    except ValueError:  # it folds; `write_root_map` warns
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
    """Which of the points `(N, 3)` may belong to the head of the highest ones.

    Also the head's middle `(2,)` in x and y.
    """
    if not len(points):
        return np.zeros(0, bool), np.zeros(2)
    top = np.percentile(points[:, 2], 99.5)
    upper = points[points[:, 2] > top - _CROWN][:, :2]
    middle = np.percentile(upper, [2, 98], axis=0).mean(axis=0)
    beside = np.linalg.norm(points[:, :2] - middle, axis=1)
    return (points[:, 2] > top - _HEIGHT) & (beside < _RADIUS), middle


def _under_the_hair(points: Array, view: Array, most: int) -> tuple[Array, Array] | None:
    """Approximate scalp points `(G, 3)` under the crown's hair, with normals.

    From hair points `(N, 3)` with directions `view (N, 3)` to their cameras; at most `most`, so
    that they weigh no more than the skin.
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
    """One point per cell, for even weights."""
    first = _one_a_cell(points)
    return points[first], None if normals is None else normals[first]


def _one_a_cell(points: Array) -> Ints:
    cell = np.floor(points / _CELL).astype(np.int64)
    return np.sort(np.unique(cell, axis=0, return_index=True)[1])

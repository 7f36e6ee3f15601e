"""Rays meet planes of light: the points of a sweep (Photobooth §3.1)."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from scipy.spatial import cKDTree

from reconstruction.arrays import Array, Bools
from reconstruction.capture.folder import Capture
from reconstruction.capture.records import CaptureError
from reconstruction.geometry.projectors import Projector
from reconstruction.images.silhouettes import NoSilhouette, silhouette
from reconstruction.light_planes.motion import Motion
from reconstruction.light_planes.peaks import CLEAN, Peaks, find_peaks
from reconstruction.light_planes.plane_conditioning import row_pitch
from reconstruction.light_planes.point_cloud import PointCloud
from reconstruction.report.report import Progress, Stage, silent

MIN_ANGLE_DEG = 10.0  # least angle between ray and plane
MAX_DEVIATION = 2.5e-3  # metres: the largest standard deviation along the ray
HULL_MARGIN = 1.0  # pixels that a point may be outside a silhouette
NEIGHBOURS, ISOLATION = 8, 1.6  # see `supported`

RADIUS, ROUGHNESS = 2.5e-3, 3e-4
"""Metres: a neighbourhood's size, and the deviation of fibres from its plane (`flatten`)."""

CHUNK = 20_000  # points processed together: about 4 kB each


def sweep_peaks(capture: Capture, progress: Progress = silent) -> list[Peaks]:
    """The stripes of every camera and projector, streamed from disk.

    Raises `CaptureError` for a capture without scanline frames.
    """
    swept = {s.projector for s in capture.of_kind("scanline")}
    names = [p.name for p in capture.rig.projectors if p.name in swept]
    if not names:
        raise CaptureError(
            f"{capture.path}: no scanline frames to triangulate: capture a sweep, or use the "
            "method 'hull'"
        )
    pairs = [(c.name, p) for c in capture.rig.cameras for p in names]
    peaks = []
    for i, (camera, projector) in enumerate(pairs):
        progress(f"scanlines of {projector} in {camera}", i / len(pairs))
        peaks.append(find_peaks(capture, camera, projector))
    progress("scanlines", 1.0)
    return peaks


def triangulate(
    capture: Capture,
    *,
    motion: Motion | None = None,
    peaks: list[Peaks] | None = None,
    hull: bool = True,
    progress: Progress = silent,
    stage: Stage | None = None,
) -> PointCloud:
    """Points of all cameras and projectors in the reference pose.

    `motion` undoes the subject's motion (None: it did not move); stripes of steps of unknown pose
    are ignored. `peaks` are those of `sweep_peaks`, if known. `hull` drops points outside the
    silhouettes. Figures and warnings go into `stage`. Raises `CaptureError` for a capture without a
    sweep; the cloud may be empty.
    """
    stage = stage or Stage("triangulation")
    if peaks is None:
        peaks = sweep_peaks(capture, progress)
    cameras = tuple(c.name for c in capture.rig.cameras)
    projectors = tuple(p.name for p in capture.rig.projectors)
    clouds = [PointCloud.empty(cameras, projectors)]
    clouds += [intersect(capture, p, motion) for p in peaks if len(p.row)]
    cloud = PointCloud.merged(clouds)
    counts = {
        "bright_pixels": sum(p.bright for p in peaks),
        "side_responses": sum(p.side_responses for p in peaks),
        "bright_maxima": sum(p.candidates for p in peaks),
        "stripes": sum(len(p.row) for p in peaks),
        "well_conditioned": len(cloud),
    }
    for p in peaks:
        if p.missing_rows:
            stage.warn(
                f"{p.camera}: {len(p.missing_rows)} scanlines of {p.projector} are missing "
                f"(first {p.missing_rows[0]}); pixels that they light have no point"
            )
        elif not len(p.row):
            stage.warn(f"{p.camera}: no stripe of {p.projector} was found")
    if hull:
        cloud = cloud.subset(inside_hull(capture, cloud.points, stage))
    counts["inside_hull"] = len(cloud)
    cloud = fuse(cloud)
    counts["after_fusion"] = len(cloud)
    centers, focal = zip(*((c.center, c.K[0, 0]) for c in capture.rig.cameras), strict=True)
    away = np.linalg.norm(np.array(centers)[cloud.camera] - cloud.points, axis=1)
    pixel = away / np.array(focal)[cloud.camera]
    cloud = cloud.subset(supported(cloud.points, pixel, NEIGHBOURS, ISOLATION))
    backing = support(cloud.points, RADIUS)
    cloud = replace(cloud, weight=(cloud.weight * backing).astype(np.float32))
    cloud = flatten(cloud, RADIUS, ROUGHNESS)
    counts["points"] = len(cloud)
    stage.figures.update(counts)
    if len(cloud):
        stage.figures["deviation_mm"] = {
            f"p{q}": float(np.percentile(cloud.deviation_along_view(), q) * 1e3)
            for q in (10, 50, 90)
        }
    if len(cameras) == 1:
        stage.warn("one camera: points are not confirmed by a second one")
    if not len(cloud):
        stage.warn("no point was triangulated: check exposure, projector level and line of sight")
    return cloud


def intersect(capture: Capture, peaks: Peaks, motion: Motion | None) -> PointCloud:
    """Ray-plane intersections of one camera and projector, in the reference pose.

    The deviation along the ray is that of the row times the shift per row, which grows with
    1 / sin(angle between ray and plane); across it is a pixel's footprint. Points beyond
    `MIN_ANGLE_DEG` or `MAX_DEVIATION`, or behind camera or projector, are dropped.
    """
    camera = capture.rig.camera(peaks.camera)
    projector = capture.rig.projector(peaks.projector)
    rays = camera.rays(peaks.pixel)
    distance, sine = _cut(camera.center, rays, projector, peaks.row)
    step = 0.25  # rows, for the derivative of the distance by the row
    ahead = _cut(camera.center, rays, projector, peaks.row + step)[0]
    behind = _cut(camera.center, rays, projector, peaks.row - step)[0]
    usable = np.isfinite(distance) & np.isfinite(ahead) & np.isfinite(behind)
    usable &= (distance > 0) & (sine >= np.sin(np.radians(MIN_ANGLE_DEG)))
    distance, ahead, behind = (np.where(usable, d, 1.0) for d in (distance, ahead, behind))
    per_row = np.abs(ahead - behind) / (2 * step)
    along = peaks.deviation * per_row
    points = camera.center + distance[:, None] * rays
    across = distance / np.sqrt(camera.K[0, 0] * camera.K[1, 1]) / np.sqrt(12)
    usable &= (along <= MAX_DEVIATION) & (projector.project(points)[1] > 0)
    outer = rays[:, :, None] * rays[:, None, :]
    covariance = (along**2)[:, None, None] * outer
    covariance += (across**2)[:, None, None] * (np.eye(3) - outer)
    view = -rays
    if motion is not None:
        usable &= motion.known(peaks.step)
    if motion is not None and not motion.still:
        points, view, covariance = motion.undo(peaks.step, points, view, covariance)
    n = int(usable.sum())
    index = {c.name: i for i, c in enumerate(capture.rig.cameras)}
    beams = {p.name: i for i, p in enumerate(capture.rig.projectors)}
    # best attainable: perpendicular planes and the deviation of a clean stripe
    best = CLEAN * row_pitch(projector, points[usable])
    return PointCloud(
        points=points[usable],
        covariance=covariance[usable],
        view=view[usable],
        pixel=peaks.pixel[usable].astype(np.int32),
        camera=np.full(n, index[peaks.camera], np.int16),
        projector=np.full(n, beams[peaks.projector], np.int16),
        row=peaks.row[usable].astype(np.float32),
        step=peaks.step[usable].astype(np.int32),
        brightness=peaks.brightness[usable].astype(np.float32),
        weight=np.minimum(1.0, (best / along[usable]) ** 2).astype(np.float32),
        cameras=tuple(index),
        projectors=tuple(beams),
    )


def inside_hull(capture: Capture, points: Array, stage: Stage | None = None) -> Bools:
    """Which `points (N, 3)` lie within `HULL_MARGIN` pixels of the silhouette of every camera that
    has one and has the point in its image."""
    keep = np.ones(len(points), bool)
    for camera in capture.rig.cameras:
        try:
            mask = silhouette(capture, camera.name)
        except NoSilhouette as error:
            if stage is not None:
                stage.warn(f"no hull culling by {camera.name}: {error}")
            continue
        if not mask.any():
            continue
        outside = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)
        visible, x, y, _ = camera.pixels_of(points)
        keep &= ~(visible & (outside[y, x] > HULL_MARGIN))
    return keep


def fuse(cloud: PointCloud) -> PointCloud:
    """Information-weighted means of the points of one camera pixel that agree along the ray.

    Neighbours in depth agree within three joint deviations, or 1 mm, and 1 mm across the ray. The
    result has the best point's projector, row and step.
    """
    if len(cloud) < 2:
        return cloud
    depth = -np.einsum("ni,ni->n", cloud.points, cloud.view)
    sigma = cloud.deviation_along_view()
    order = np.lexsort((depth, cloud.pixel[:, 0], cloud.pixel[:, 1], cloud.camera))
    key = np.stack([cloud.camera, *cloud.pixel.T], axis=1)[order]
    aside = np.cross(np.diff(cloud.points[order], axis=0), cloud.view[order][1:])
    same = (key[1:] == key[:-1]).all(axis=1) & (np.linalg.norm(aside, axis=1) <= 1e-3)
    gap = depth[order][1:] - depth[order][:-1]
    joint = np.maximum(3 * np.hypot(sigma[order][1:], sigma[order][:-1]), 1e-3)
    group = np.concatenate([[0], np.cumsum(~(same & (gap <= joint)))])
    count = group[-1] + 1
    information = 1 / sigma[order] ** 2
    total = np.bincount(group, information, count)
    points = np.stack(
        [np.bincount(group, information * p, count) for p in cloud.points[order].T], axis=1
    )
    best = np.lexsort((-information, group))
    best = best[np.concatenate([[True], np.diff(group[best]) > 0])]
    kept = cloud.subset(order[best])
    along = (1 / total)[:, None, None]
    outer = kept.view[:, :, None] * kept.view[:, None, :]
    covariance = kept.covariance + (along - 1 / information[best][:, None, None]) * outer
    weight = np.minimum(1.0, kept.weight * total / information[best]).astype(np.float32)
    return replace(kept, points=points / total[:, None], covariance=covariance, weight=weight)


def supported(points: Array, pixel: Array, neighbours: int, isolation: float) -> Bools:
    """Which `points (N, 3)` are not outliers `(N,)`.

    The distance to neighbour number `neighbours` is at most `isolation` times the median over all
    points, both in units of `pixel (N,)`, the footprint of the camera's pixel. With `neighbours` 0
    all stay, with no more than `neighbours` points none.
    """
    if neighbours < 1:
        return np.ones(len(points), bool)
    if len(points) <= neighbours:
        return np.zeros(len(points), bool)
    distance = cKDTree(points).query(points, k=[neighbours + 1])[0][:, 0] / pixel
    return np.asarray(distance <= isolation * np.median(distance))


def support(points: Array, radius: float, neighbours: int = 32) -> Array:
    """Support of each of `points (N, 3)` by others: `(N,)` in (0, 1), 0.5 for the median.

    At most `neighbours` count, by a Gaussian of `radius` metres.
    """
    if not len(points):
        return np.zeros(0)
    k = min(neighbours, len(points) - 1) + 1
    tree, score = cKDTree(points), np.empty(len(points))
    for first in range(0, len(points), CHUNK):
        part = slice(first, first + CHUNK)
        distance = tree.query(points[part], k=np.arange(1, k + 1))[0]
        score[part] = np.exp(-0.5 * (distance / radius) ** 2).sum(axis=1)
    return np.asarray(score / (score + np.median(score)))


def flatten(cloud: PointCloud, radius: float, roughness: float, neighbours: int = 40) -> PointCloud:
    """Kalman update of each point with its neighbours' plane, of deviation `roughness` metres.

    The plane is that of the neighbours within about `radius` metres, weighted by their information
    and `PointCloud.weight`. Points with under eight neighbours within 2 `radius` do not change.
    """
    n = len(cloud)
    k = min(neighbours, n - 1)
    if k < 8:
        return cloud
    tree = cKDTree(cloud.points)
    information = cloud.weight / (cloud.deviation_along_view() ** 2 + roughness**2)

    def planes(first: int) -> tuple[Array, Array, Bools]:
        """Middles and normals of the planes of some points, and whether neighbours are enough."""
        distance, index = tree.query(cloud.points[first : first + CHUNK], k=k + 1)
        near = np.exp(-0.5 * (distance / radius) ** 2) * (distance <= 2 * radius)
        weight = near * information[index]
        weight /= weight.sum(axis=1, keepdims=True)
        neighbour = cloud.points[index]
        mean = np.einsum("nk,nki->ni", weight, neighbour)
        offset = neighbour - mean[:, None]
        moments = np.einsum("nk,nki,nkj->nij", weight, offset, offset)
        return mean, np.linalg.eigh(moments)[1][:, :, 0], (near > 0).sum(axis=1) > 8

    parts = zip(*map(planes, range(0, n, CHUNK)), strict=True)
    mean, normal, use = (np.concatenate(part) for part in parts)
    residual = np.einsum("ni,ni->n", cloud.points - mean, normal)
    gain = np.einsum("nij,nj->ni", cloud.covariance, normal)
    total = np.einsum("ni,ni->n", gain, normal) + roughness**2
    step = np.where(use, residual / total, 0.0)[:, None] * gain
    reduced = gain[:, :, None] * gain[:, None, :] / total[:, None, None]
    return replace(
        cloud,
        points=cloud.points - step,
        covariance=cloud.covariance - np.where(use[:, None, None], reduced, 0.0),
    )


def _cut(origin: Array, rays: Array, projector: Projector, row: Array) -> tuple[Array, Array]:
    """Distances along `rays (N, 3)` to the planes of `row (N,)`, inf if parallel, and |sin|."""
    plane = projector.plane(row)
    sine = (rays * plane[:, :3]).sum(axis=1)
    height = plane[:, :3] @ origin + plane[:, 3]
    flat = np.abs(sine) < 1e-9
    return np.where(flat, np.inf, -height / np.where(flat, 1.0, sine)), np.abs(sine)

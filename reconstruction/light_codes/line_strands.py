"""Polylines from line stereo, and their fusion with measured tangents."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from reconstruction.arrays import AnyFloats, Array
from reconstruction.capture.records import CaptureError
from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.mesh_queries import surface_samples
from reconstruction.geometry.voxels import VoxelGrid
from reconstruction.growth.surface_strands import SurfaceOptions, surface_strands
from reconstruction.light_codes.code_views import View, views_of
from reconstruction.light_codes.depth_range import depth_range, hair_volume
from reconstruction.light_codes.extension import extend, fewest_views
from reconstruction.light_codes.lmvs import LmvsSearch
from reconstruction.light_codes.search import DepthMap, DepthSearch
from reconstruction.light_codes.segments import Segments, count_supports, thinned_lines, to_segments
from reconstruction.masks import MaskedCapture
from reconstruction.reconstruct_options import LightCodeOptions
from reconstruction.report.report import Progress, Report, silent
from reconstruction.tangents.estimate import Measured

VOLUME_GRID = 4e-3  # metres: the voxels in which depths are bounded

SUPPORT_DISTANCE, SUPPORT_ANGLE_DEG = 1.5e-3, 15.0
"""Metres and degrees within which the segments of two views agree."""

CROWD = 3e-4
"""Metres: lines are averaged in cells of this size before strands are traced through them."""

MOST_LINES = 1_000_000
"""More are averaged in larger cells, and strands traced further apart, to bound run time."""

SEGMENT_WEIGHT = 4.0
"""Factor on segments' confidence in an orientation field shared with measured tangents."""

TRACING = SurfaceOptions(apart=6e-4, shortest=5.0, smooth=2.0)


def build_views(
    masked: MaskedCapture,
    head: Mesh | None,
    report: Report,
    *,
    options: LightCodeOptions = LightCodeOptions(),
    progress: Progress = silent,
) -> tuple[list[View], VoxelGrid]:
    """The views, and the volume that holds the hair; adds the stage `lightcodes` to the report."""
    capture, masks, cameras = masked.capture, masked.masks, masked.cameras
    hair = {c.name: masks[c.name].hair for c in cameras}
    subject = {c.name: masks[c.name].subject for c in cameras}
    if not any(m.any() for m in hair.values()):
        raise CaptureError(f"{capture.path}: no camera's mask holds hair: check the masks")
    with report.stage("lightcodes") as stage:
        try:
            volume = hair_volume(cameras, subject, head, VOLUME_GRID)
        except ValueError as error:
            raise CaptureError(f"{capture.path}: no volume for hair: {error}") from error
        if not volume.inside.any():
            raise CaptureError(
                f"{capture.path}: no volume is visible in enough cameras: check masks, head.obj "
                "and poses"
            )
        center = volume.centers().mean(axis=0)
        views = views_of(capture, hair, center, options.bank, stage, progress)
    return views, volume


def _depth_maps(
    views: list[View],
    volume: VoxelGrid,
    report: Report,
    method: Literal["photometric", "lmvs"],
    options: LightCodeOptions,
    progress: Progress,
) -> list[DepthMap]:
    """Depth maps of all views; adds the stage `depth` to the report."""
    with report.stage("depth") as stage:
        kind = DepthSearch if method == "photometric" else LmvsSearch
        search = kind(views, volume.centers().mean(axis=0), options.search)
        maps = []
        for k, view in enumerate(views):
            progress("searching depths", k / len(views))
            maps.append(search.run(k, *depth_range(view.camera, volume)))
        visible = np.concatenate([m.visible_count for m in maps])
        stage.figures.update(
            segments={v.camera.name: len(m.x) for v, m in zip(views, maps, strict=True)},
            reference_pixels={v.camera.name: int(v.mask.sum()) for v in views},
            visible_neighbours=float(visible.mean()) if len(visible) else 0.0,
        )
        for name in ("agreement", "spread", "misfit"):
            stage.figures[name] = _percentiles(np.concatenate([getattr(m, name) for m in maps]))
    return maps


def _agreed_segments(
    views: list[View], maps: list[DepthMap], least: int, report: Report, path: Path
) -> Segments:
    """Segments that `least` views agree on; adds the stage `segments` to the report."""
    with report.stage("segments") as stage:
        segments = count_supports(
            views,
            maps,
            to_segments(views, maps),
            distance=SUPPORT_DISTANCE,
            angle_deg=SUPPORT_ANGLE_DEG,
        )
        supports = np.bincount(segments.supports, minlength=len(views) + 1)
        kept = segments.subset(segments.supports >= least)
        stage.figures.update(
            found=len(segments),
            kept=len(kept),
            views_in_agreement={str(k): int(n) for k, n in enumerate(supports) if n},
        )
        if not len(kept):
            raise CaptureError(
                f"{path}: no segment of {len(segments)} agrees in {least} of {len(views)} views: "
                "add cameras with overlapping views, use sharper or larger images, or lower "
                "light_codes.least_views"
            )
    return kept


def connect_segments(views: list[View], segments: Segments, report: Report) -> list[Array]:
    """Polylines `(N, 3)` through the segments, extended at their tips."""
    with report.stage("connection") as stage:
        weights = (segments.confidence * segments.supports) ** 2
        points, directions, weights = thinned_lines(
            segments.points, segments.directions, weights, CROWD
        )
        coarser = 1
        while len(points) > MOST_LINES:
            coarser *= 2
            points, directions, weights = thinned_lines(
                points, directions, weights, coarser * CROWD
            )
        tracing = replace(TRACING, apart=coarser * TRACING.apart)
        usual = np.median(weights[weights > 0]) if (weights > 0).any() else 1.0
        lines = Measured(points, directions, np.minimum(weights / usual, 1.0))
        found = [p.astype(float) for p in surface_strands(lines, tracing)]
        grown = extend(views, found)
        stage.figures.update(
            lines=len(points),
            cells_mm=1e3 * coarser * CROWD,
            strands=len(found),
            metres=_metres(found),
            metres_extended=_metres(grown),
            views_to_extend=fewest_views(len(views)),
        )
    return grown


def line_strands(
    masked: MaskedCapture,
    head: Mesh | None,
    report: Report,
    *,
    method: Literal["photometric", "lmvs"] = "photometric",
    options: LightCodeOptions = LightCodeOptions(),
    progress: Progress = silent,
) -> tuple[list[AnyFloats], Segments]:
    """Unrooted polylines `(N, 3)` from line stereo, see `roots_first`, and their segments.

    At least `least_views` of the views (all, if there are fewer) agree on a segment. Adds the
    stages `lightcodes`, `depth`, `segments` and `connection` to the report. Raises `CaptureError`
    for fewer than two views of hair, or if no segment is left.
    """
    views, volume = build_views(masked, head, report, options=options, progress=progress)
    maps = _depth_maps(views, volume, report, method, options, progress)
    least = min(options.least_views, len(views))
    segments = _agreed_segments(views, maps, least, report, masked.capture.path)
    return roots_first([*connect_segments(views, segments, report)], head), segments


def merge(measured: Measured, segments: Segments, weight: float = 1.0) -> Measured:
    """The lines of both methods; segments' confidences are multiplied by `weight`."""
    return Measured(
        np.concatenate([measured.points, segments.points]),
        np.concatenate([measured.directions, segments.directions]),
        np.concatenate([measured.confidence, weight * segments.confidence]),
    )


def roots_first(polylines: list[AnyFloats], head: Mesh | None) -> list[AnyFloats]:
    """The polylines `(N, 3)`, each with the end nearer to the head first, or else the higher."""
    if not polylines:
        return []
    ends = np.stack([[p[0] for p in polylines], [p[-1] for p in polylines]], axis=1)
    if head is None:
        far = -ends[:, :, 2]
    else:
        samples, _, _ = surface_samples(head, 2e-3)
        far = cKDTree(samples).query(ends)[0]
    return [p if a <= b else p[::-1] for p, (a, b) in zip(polylines, far, strict=True)]


def _metres(polylines: list[Array]) -> float:
    return float(sum(np.linalg.norm(np.diff(p, axis=0), axis=1).sum() for p in polylines))


def _percentiles(values: AnyFloats) -> dict[str, float]:
    if not len(values):
        return {}
    return {f"p{q}": float(np.percentile(values, q)) for q in (10, 50, 90)}

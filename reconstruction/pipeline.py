"""From a capture folder to strands: every stage of the light-plane method, with its report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Literal

import numpy as np

from reconstruction.arrays import AnyFloats
from reconstruction.capture.folder import Capture, CaptureError
from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.strands import Strands
from reconstruction.geometry.voxels import VoxelGrid
from reconstruction.growth.field import OrientationField, solve_field
from reconstruction.growth.from_roots import Coverage, Tracing, fill_gaps, grow_from_roots
from reconstruction.growth.hair_envelope import build_envelope
from reconstruction.growth.rooting import root_all
from reconstruction.growth.surface_strands import SurfaceOptions, surface_strands
from reconstruction.head.fitted import FittedHead, digitised_points, lay_head, skin_points
from reconstruction.head.root_map import write_root_map
from reconstruction.head.scalp import Scalp, find_scalp, sample_roots
from reconstruction.images.segmentation import Network
from reconstruction.light_codes.line_strands import line_strands, merge
from reconstruction.light_planes import (
    Motion,
    PointCloud,
    solve_motion,
    sweep_peaks,
    triangulate,
)
from reconstruction.masks import MaskedCapture, hair_masks, usable_masks
from reconstruction.methods import METHODS, Method
from reconstruction.model import Model
from reconstruction.reconstruct_options import ReconstructOptions
from reconstruction.report.report import Progress, Report, Stage, silent
from reconstruction.tangents.estimate import Measured, measure_tangents

HEAD_OF_HAIR = 100_000 * 40e-6
"""Metres of fibre radius on a head: 100,000 fibres of 40 µm (Photobooth §3.4)."""

LEAST_CONFIDENCE = 0.1
"""Of a measured tangent to count."""

SPACING = 2e-3
"""Metres between a strand's points as it is written."""


def reconstruct(
    capture: Capture,
    model: Model,
    *,
    method: Method = "light_planes",
    options: ReconstructOptions = ReconstructOptions(),
    motion: Motion | None = None,
    progress: Progress = silent,
) -> Report:
    """Reconstruct the strands of `capture` into `model`.

    `motion` is the subject's where it is known from elsewhere; None solves for it.

    Writes `strands.npz`, `strands.hair`, `strands.usdc`, `points.npz`, `scalp_map.npz`,
    `masks/*.png`, `head.obj` where the capture has none, and `report.json`, whose stages of the
    same name are replaced. Raises `CaptureError` where the capture lacks what the method cannot do
    without: OLAT frames, a head or points to lay one under, two cameras.
    """
    if method not in METHODS:
        raise ValueError(f"unknown method {method!r}; there are {', '.join(METHODS)}")
    report = model.create().report()
    whole = _undistorted(capture, report)
    capture = _without(whole, options.held_out)
    head, fitted = capture.head, _digitised_head(capture, model, options, report)
    if fitted is not None:
        head = fitted.mesh

    with report.stage("triangulation") as stage:
        cloud = _points(capture, motion, options, report, stage, progress)
        model.write_points(cloud)
    with report.stage("masks") as stage:
        # a held-out camera's mask says where to compare pictures; nothing here looks at it
        network = None if options.network is None else Network(options.network)
        every = hair_masks(whole, cloud if len(cloud) else None, head, network=network)
        if network is not None:
            stage.figures["network"] = network.to_dict()
        for name, mask in every.items():
            model.write_mask(name, "hair", whole.mask_as_shot(name, mask.hair))
            model.write_mask(name, "skin", whole.mask_as_shot(name, mask.skin))
        masks = usable_masks(capture, every, stage)
        stage.figures["hair_pixels"] = {k: int(m.hair.sum()) for k, m in masks.items()}
        stage.figures["source"] = {k: m.source for k, m in masks.items()}
    masked = MaskedCapture(capture, masks)
    if method in ("photometric", "lmvs"):
        strands = _line_strands(masked, head, method, options, report, progress)
        model.write_strands(strands)
        model.write_report(report)
        return report
    if head is None:
        with report.stage("head") as stage:
            skin = skin_points(capture, cloud, masks)
            fitted = lay_head(skin, options.head_mesh, stage, cloud=cloud, seed=options.seed)
            model.write_head(fitted.mesh)
        head = fitted.mesh
    with report.stage("envelope") as stage:
        envelope, depths = build_envelope(
            masked, cloud, head, grid=options.grid, margin=options.margin, stage=stage
        )
    with report.stage("orientation") as stage:
        measured = measure_tangents(masked, cloud.points, depths, options.measure, stage, progress)
    seen = _surface(measured, cloud, options, report, progress)
    if method == "fused":
        more, segments = line_strands(
            masked, head, report, options=options.light_codes, progress=progress
        )
        seen += more
        measured = merge(measured, segments)
    with report.stage("field") as stage:
        scalp = find_scalp(head, envelope)
        field = _field(envelope, measured, scalp, options, stage)
    with report.stage("strands") as stage:
        strands = grow(field, scalp, options, stage, progress, seen)
        model.write_strands(strands)
        write_root_map(model, strands, scalp, fitted.scalp_map if fitted else None, stage)
    model.write_report(report)
    return report


def _line_strands(
    masked: MaskedCapture,
    head: Mesh | None,
    method: Literal["photometric", "lmvs"],
    options: ReconstructOptions,
    report: Report,
    progress: Progress,
) -> Strands:
    """Strands from line stereo alone: only what is seen, none of them rooted."""
    polylines, _ = line_strands(
        masked, head, report, method=method, options=options.light_codes, progress=progress
    )
    with report.stage("strands") as stage:
        radius = options.radius or float(np.clip(HEAD_OF_HAIR / max(len(polylines), 1), 4e-5, 4e-4))
        strands = Strands.from_list([p.astype(np.float32) for p in polylines], radius)
        stage.figures.update(strands=len(strands), metres=float(strands.lengths().sum()))
        stage.leave_out(
            "roots",
            "line stereo measures what is seen; the method 'fused' leads it to the scalp",
            "the field and the growth",
        )
    return strands


def _digitised_head(
    capture: Capture, model: Model, options: ReconstructOptions, report: Report
) -> FittedHead | None:
    """The head under the user's scalp points; they win over `head.obj` where asked for."""
    model.remove("head.obj")
    report.stages = [s for s in report.stages if s.name != "head"]
    if capture.head is not None and options.scalp_points is None:
        return None
    points = digitised_points(capture, options.scalp_points)
    if points is None:
        return None
    with report.stage("head") as stage:
        fitted = lay_head(points, options.head_mesh, stage, seed=options.seed)
        model.write_head(fitted.mesh)
    return fitted


def _undistorted(capture: Capture, report: Report) -> Capture:
    """The capture through pinholes; "lenses" says how much of each picture with a lens is left."""
    report.stages = [s for s in report.stages if s.name != "lenses"]
    if not any(c.distorted for c in capture.rig.cameras):
        return capture
    with report.stage("lenses") as stage:
        out = capture.view(undistorted=True)
        kept = {name: lens.kept() for name, lens in out.lenses.items()}
        stage.figures["pixels_kept"] = kept
        for name, share in kept.items():
            if share < 0.85:
                stage.warn(
                    f"{name}: {1 - share:.0%} of the picture lie outside the undistorted one"
                )
    return out


def _without(capture: Capture, cameras: tuple[str, ...]) -> Capture:
    """The capture as if it had never had these cameras."""
    for name in cameras:
        capture.rig.camera(name)
    left = [c.name for c in capture.rig.cameras if c.name not in cameras]
    if len(left) < 2:
        raise CaptureError(f"{capture.path}: {len(left)} cameras are left, at least 2 are needed")
    return capture.view(cameras=left)


def _points(
    capture: Capture,
    motion: Motion | None,
    options: ReconstructOptions,
    report: Report,
    stage: Stage,
    progress: Progress,
) -> PointCloud:
    """Triangulated points in the reference pose; none where there was no sweep."""
    names = tuple(c.name for c in capture.rig.cameras)
    if not capture.of_kind("scanline"):
        why = "the rig has no projector" if not capture.rig.projectors else "no sweep was shot"
        stage.leave_out("triangulation and motion", why, "the scanline sweep and its solve")
        return PointCloud.empty(names, tuple(p.name for p in capture.rig.projectors))
    peaks = sweep_peaks(capture, progress=progress)
    if motion is None:
        first = triangulate(capture, peaks=peaks, stage=Stage("first pass"))
        with report.stage("motion") as motion_stage:
            motion = solve_motion(
                capture, first, options=options.motion, progress=progress, stage=motion_stage
            )
    return triangulate(
        capture,
        motion=None if motion.still else motion,
        peaks=peaks,
        progress=progress,
        stage=stage,
    )


def _surface(
    measured: Measured,
    cloud: PointCloud,
    options: ReconstructOptions,
    report: Report,
    progress: Progress,
) -> list[AnyFloats]:
    """Polylines through the measured lines; none of them rooted."""
    with report.stage("surface") as stage:
        if not len(cloud):
            stage.leave_out(
                "strands through the measured lines themselves",
                "without a sweep lines lie on the visual hull, millimetres off",
                "this stage; strands follow the field alone",
            )
            return []
        progress("tracing the surface", 0.0)
        surface = SurfaceOptions(apart=options.measure.thin, longest=options.max_length)
        good = measured.where(measured.confidence >= LEAST_CONFIDENCE)
        polylines = surface_strands(good, surface, seed=options.seed)
        stage.figures.update(strands=len(polylines), options=asdict(surface))
    return list(polylines)


def _field(
    envelope: VoxelGrid,
    measured: Measured,
    scalp: Scalp,
    options: ReconstructOptions,
    stage: Stage,
) -> OrientationField:
    keep = measured.confidence >= LEAST_CONFIDENCE
    if not keep.any():
        raise CaptureError("no hair pixel has a direction: are the OLAT frames in focus and lit?")
    kept = measured.where(keep)
    field, series = solve_field(
        envelope,
        kept.points,
        kept.directions,
        kept.confidence,
    )
    if series is not None:
        stage.series.append(series)
    stage.figures.update(
        unknowns=int((~field.measured).sum()),
        measured_voxels=int(field.measured.sum()),
        empty_voxels=int(field.empty.sum()),
        degenerate_voxels=int(field.degenerate.sum()),
        scalp_cm2=scalp.area * 1e4,
        scalp_marked=scalp.marked,
    )
    if field.empty.any():
        stage.warn(f"{int(field.empty.sum())} voxels hang together with no measurement: left empty")
    return field


def grow(
    field: OrientationField,
    scalp: Scalp,
    options: ReconstructOptions,
    stage: Stage,
    progress: Progress = silent,
    seen: Sequence[AnyFloats] = (),
) -> Strands:
    """Strands from the scalp, then through the gaps that those leave, all of them rooted.

    `seen` polylines `(n, 3)` were measured as they are; they get roots like those through gaps.
    """
    roots, normals = sample_roots(scalp, options.roots, options.seed)
    progress("growing strands", 0.1)
    tracing = Tracing(max_length=options.max_length)
    rooted = grow_from_roots(field, roots, normals, tracing)
    coverage = Coverage(field)
    for path in rooted:
        coverage.add(path)
    for polyline in seen:
        coverage.add(polyline)
    share = float(coverage.covered[field.valid].mean())
    progress("filling gaps", 0.4)
    loose = fill_gaps(field, coverage, tracing, seed=options.seed, within=options.within)
    filled = float(coverage.covered[field.valid].mean())
    progress("rooting strands", 0.7)
    loose = [polyline.astype(np.float32) for polyline in seen] + loose
    result = root_all(rooted, loose, scalp)
    if not result.strands:
        raise CaptureError("no strand could be grown: the envelope does not reach the scalp")
    radius = options.radius
    if radius is None:
        radius = float(np.clip(HEAD_OF_HAIR / len(result.strands), 4e-5, 4e-4))
    strands = Strands.from_list(result.strands, radius).resampled(SPACING)
    stage.figures.update(
        strands=len(strands),
        from_roots=len(rooted),
        roots_without_strand=options.roots - len(rooted),
        through_gaps=len(loose),
        gaps_led_to_scalp=result.to_scalp,
        gaps_joined_to_strand=result.joined,
        gaps_dropped=result.dropped,
        covered_by_roots=share,
        covered=filled,
        metres=float(strands.lengths().sum()),
        radius=radius,
        options=asdict(options),
    )
    if result.dropped:
        stage.warn(f"{result.dropped} strands through gaps reached no root and were dropped")
    return strands

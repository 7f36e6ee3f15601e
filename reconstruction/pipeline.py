"""From a capture folder to strands: the stages, in order.

`reconstruct` is the way of a capture through all of them; `_Stages` has each of them, with what it
says in the report.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Literal

import numpy as np

from reconstruction.arrays import AnyFloats, Array
from reconstruction.capture.folder import Capture, CaptureError
from reconstruction.capture.kept_frames import frames_kept
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.mesh_queries import inside_mesh
from reconstruction.geometry.strands import Strands
from reconstruction.geometry.voxels import VoxelGrid
from reconstruction.growth.field import OrientationField, solve_field, with_descent
from reconstruction.growth.from_roots import Coverage, Tracing, fill_gaps, grow_from_roots
from reconstruction.growth.hair_envelope import (
    SHELL,
    build_envelope,
    build_hull,
    pixel_size,
)
from reconstruction.growth.refinement import refine, supported
from reconstruction.growth.rooting import root_all
from reconstruction.growth.surface_strands import SurfaceOptions, surface_strands
from reconstruction.head.capture_head import FittedHead
from reconstruction.head.heads import Heads
from reconstruction.head.scalp import Scalp, find_scalp, sample_roots
from reconstruction.head.scalp_map import ScalpMap, write_root_map
from reconstruction.light_codes.line_strands import (
    SEGMENT_WEIGHT,
    line_strands,
    merge,
    roots_first,
)
from reconstruction.light_codes.segments import Segments
from reconstruction.light_planes import Motion, PointCloud, solve_motion, sweep_peaks, triangulate
from reconstruction.masks import MaskedCapture, hair_masks, report_agreement, usable_masks
from reconstruction.methods import METHODS, Method
from reconstruction.model import Model
from reconstruction.reconstruct_options import ReconstructOptions
from reconstruction.report.progress import ToldReport, part_of
from reconstruction.report.report import Progress, Report, Stage, silent
from reconstruction.tangents.estimate import Measured, measure_tangents

HEAD_OF_HAIR = 100_000 * 40e-6
"""Metres of fibre radius on a head: 100,000 fibres of 40 µm (Photobooth §3.4)."""

LEAST_CONFIDENCE = 0.1  # of a measured tangent to count
FINE_PIXEL = 1e-3  # metres: line stereo finds next to nothing on pixels twice as wide
SPACING = 2e-3  # metres between a strand's points as it is written

_SEEN, _GROWN = ("envelope", "orientation"), ("field", "strands", "refinement", "roots")
_LINES = ("lightcodes", "depth", "segments", "connection")
STAGES: dict[str, tuple[str, ...]] = {
    "light_planes": ("triangulation", "masks", *_SEEN, "surface", *_GROWN),
    "fused": ("triangulation", "masks", *_SEEN, "surface", *_LINES, *_GROWN),
    "photometric": ("triangulation", "masks", *_LINES, "strands"),
    "lmvs": ("triangulation", "masks", *_LINES, "strands"),
    "hull": ("masks", *_SEEN, *_GROWN),
}
"""What each method goes through, as far as it is known before: for the progress."""


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
    `masks/*.png`, `head.obj` where the capture has none, and `report.json`. What was made of the
    model's earlier strands is removed. Raises `CaptureError` where the capture lacks what the
    method cannot do without (OLAT frames, a head or points to fit one to, two cameras), or where
    no strand is found. `hull` needs masks and two cameras only, `auto` takes what the capture
    holds: `light_planes` where it has a sweep, else `hull`; the stage `method` says which.
    """
    if method not in METHODS:
        raise ValueError(f"unknown method {method!r}; there are {', '.join(METHODS)}")
    expected = STAGES[method_for(capture) if method == "auto" else method]
    report = ToldReport(progress, expected)
    stages = _Stages(model.create(), options, report.progress, report)
    with frames_kept(capture, model.path) as kept:
        _run(stages, kept, method, motion)
    if not any(stage.name == "head" for stage in report.stages):
        model.remove("head.obj")  # an earlier reconstruction's: this one has the capture's, or none
    model.write_report(report)
    progress("strands reconstructed", 1.0)
    return report


def _run(stages: _Stages, capture: Capture, method: Method, motion: Motion | None) -> None:
    """The stages of `method`, as `reconstruct` says."""
    stages.imported(capture)
    whole = stages.undistorted(capture)
    capture = without(whole, stages.options.held_out)
    heads = Heads(stages.model, stages.options, stages.progress, stages.report)
    head = heads.known(capture)
    if method == "auto":
        method = stages.chosen(capture, head)
    cloud = stages.points(capture, motion)
    masked = stages.masks(whole, capture, cloud, head)
    if method == "photometric" or method == "lmvs":
        stages.seen_strands(masked, head, method)
    elif method == "hull":
        stages.hull(masked, cloud, head or heads.by_light(masked))
    else:
        head = head or heads.under_skin(masked, cloud)
        envelope, depths = stages.envelope(masked, cloud, head.mesh)
        measured = stages.tangents(masked, cloud, depths)
        seen, lines = stages.surface(measured, cloud), measured
        if method == "fused":
            more, segments = stages.lines(masked, head, "photometric")
            seen += more
            lines, measured = merge(measured, segments), merge(measured, segments, SEGMENT_WEIGHT)
        scalp = find_scalp(head.mesh, envelope)
        field = stages.field(envelope, measured, scalp)
        grown = stages.grown(field, scalp, seen, stages.options.within)
        grown = stages.refined(grown, measured, cloud, masked.cameras, depths)
        stages.rooted(grown, lines, scalp, head.scalp_map)


def method_for(capture: Capture) -> Method:
    """What `auto` takes: planes of light where there are a sweep and single lights."""
    return "light_planes" if capture.of_kind("scanline") and capture.olat_lights() else "hull"


def without(capture: Capture, cameras: tuple[str, ...]) -> Capture:
    """The capture as if it had never had these cameras.

    Raises `KeyError` for one that is not there, `CaptureError` where under two are left.
    """
    for name in cameras:
        capture.rig.camera(name)
    left = [c.name for c in capture.rig.cameras if c.name not in cameras]
    if len(left) < 2:
        raise CaptureError(f"{capture.path}: {len(left)} cameras are left, at least 2 are needed")
    return capture.view(cameras=left)


@dataclass(frozen=True)
class _Stages:
    """The stages; each times itself and leaves its figures and warnings in the report."""

    model: Model
    options: ReconstructOptions
    progress: Progress
    report: Report

    def imported(self, capture: Capture) -> None:
        """What the import of a capture made elsewhere had to say."""
        if notes := capture.plan.get("import"):
            with self.report.stage("import") as stage:
                stage.figures["relative_units"] = bool(notes["relative"])
                for note in notes["notes"]:
                    stage.warn(note)

    def undistorted(self, capture: Capture) -> Capture:
        """The capture through pinholes; "lenses" says how much of each picture is left."""
        self.report.drop("lenses")
        if not any(c.distorted for c in capture.rig.cameras):
            return capture
        with self.report.stage("lenses") as stage:
            out = capture.view(undistorted=True)
            kept = {name: lens.kept() for name, lens in out.lenses.items()}
            stage.figures["pixels_kept"] = kept
            for name, share in kept.items():
                if share < 0.85:
                    stage.warn(
                        f"{name}: {1 - share:.0%} of the picture lie outside the undistorted one"
                    )
        return out

    def chosen(self, capture: Capture, head: FittedHead | None) -> Method:
        """The method for what the capture holds; the stage `method` says what and which."""
        with self.report.stage("method") as stage:
            sweep, lights = bool(capture.of_kind("scanline")), len(capture.olat_lights())
            method = method_for(capture)
            holds = f"{'a' if sweep else 'no'} sweep, {lights} single lights, "
            holds += f"{'no' if head is None else 'a'} head"
            stage.figures.update(method=method, capture_holds=holds)
            self.progress(f"{holds}: method {method}", 0.0)
        return method

    def points(self, capture: Capture, motion: Motion | None) -> PointCloud:
        """Triangulated points in the reference pose; none where there was no sweep."""
        rig = capture.rig
        with self.report.stage("triangulation") as stage:
            if capture.of_kind("scanline"):
                cloud = self._triangulated(capture, motion, stage)
            else:
                why = "no sweep was shot" if rig.projectors else "the rig has no projector"
                stage.leave_out("triangulation and motion", why, "the scanline sweep and its solve")
                cloud = PointCloud.empty(
                    tuple(c.name for c in rig.cameras), tuple(p.name for p in rig.projectors)
                )
            self.model.write_points(cloud)
        return cloud

    def _triangulated(self, capture: Capture, motion: Motion | None, stage: Stage) -> PointCloud:
        tell, asked = self.progress, self.options.motion
        peaks = sweep_peaks(capture, part_of(tell, 0.0, 0.8))
        if motion is None:
            first = triangulate(capture, peaks=peaks, stage=(told := Stage(stage.name)))
            with self.report.stage("motion") as solving:
                motion = solve_motion(capture, first, options=asked, progress=tell, stage=solving)
            if motion.still:
                stage.take(told)
                return first
        known = None if motion.still else motion
        return triangulate(capture, motion=known, peaks=peaks, progress=tell, stage=stage)

    def masks(
        self, whole: Capture, capture: Capture, cloud: PointCloud, head: FittedHead | None
    ) -> MaskedCapture:
        """The masks of all cameras of `whole`, of which those of `capture` are used.

        A held-out camera's mask says where to compare pictures; nothing here looks at it.
        """
        with self.report.stage("masks") as stage:
            mesh = None if head is None else head.mesh
            every = hair_masks(whole, cloud if len(cloud) else None, mesh)
            for name, mask in every.items():
                self.model.write_mask(name, "hair", whole.mask_as_shot(name, mask.hair))
                self.model.write_mask(name, "skin", whole.mask_as_shot(name, mask.skin))
            report_agreement(whole, every, cloud, mesh, stage)
            masks = usable_masks(capture, every, stage)
            stage.figures["hair_pixels"] = {k: int(m.hair.sum()) for k, m in masks.items()}
            stage.figures["source"] = {k: m.source for k, m in masks.items()}
        return MaskedCapture(capture, masks)

    def lines(
        self, masked: MaskedCapture, head: FittedHead | None, method: Literal["photometric", "lmvs"]
    ) -> tuple[list[AnyFloats], Segments]:
        """Polylines `(N, 3)` from line stereo, and the segments that they come from."""
        o, mesh, tell = self.options.light_codes, None if head is None else head.mesh, self.progress
        return line_strands(masked, mesh, self.report, method=method, options=o, progress=tell)

    def seen_strands(
        self, masked: MaskedCapture, head: FittedHead | None, method: Literal["photometric", "lmvs"]
    ) -> None:
        """Strands from line stereo alone: only what is seen, none of them rooted."""
        polylines, segments = self.lines(masked, head, method)
        why = "line stereo measures what is seen; the method 'fused' leads it to the scalp"
        with self.report.stage("strands") as stage:
            stage.leave_out("roots", why, "the field and the growth")
            lines = Measured(segments.points, segments.directions, segments.confidence)
            strands = Strands.from_list(polylines).cut(self.options.max_length)
            self._unrooted(strands, lines, stage)

    def _unrooted(self, strands: Strands, measured: Measured, stage: Stage) -> None:
        """Write strands that have no roots; raises `CaptureError` where there is none."""
        if not len(strands):
            raise CaptureError("no strand was found: the method 'hull' fills the masks' hull")
        self._write(replace(strands, radius=self._radius(len(strands))), measured, stage)

    def hull(self, masked: MaskedCapture, cloud: PointCloud, head: FittedHead | None) -> None:
        """Strands along the smooth field of the hull's surface, pulled by all that is measured.

        Single lights give directions, and line stereo where pixels are at most `FINE_PIXEL` wide.
        Without single lights nothing is measured; without a head no strand has a root.
        """
        o, olat = self.options, masked.capture.olat_lights()
        mesh = None if head is None else head.mesh
        if mesh is None:
            with self.report.stage("envelope") as stage:
                envelope, bare, depths = build_hull(masked, grid=o.grid, stage=stage)
        else:
            envelope, depths = self.envelope(masked, cloud, mesh)
            bare = inside_mesh(envelope, mesh)
        pixel = pixel_size(masked.cameras, envelope.centers().mean(axis=0))
        measured, seen = Measured.none(), list[AnyFloats]()
        if olat:
            measured = self.tangents(masked, cloud, depths)
        written = measured
        with self.report.stage("line stereo") as stage:
            if not olat:
                stage.warn("no single lights: nothing is measured, all strands are guessed")
            elif pixel > FINE_PIXEL:
                why = f"a pixel is {1e3 * pixel:.1f} mm wide, more than {1e3 * FINE_PIXEL:g}"
                stage.leave_out("line stereo", why, "its stages")
            else:
                try:
                    lines, segments = self.lines(masked, head, "photometric")
                    seen, written = list(lines), merge(measured, segments)
                    measured = merge(measured, segments, SEGMENT_WEIGHT)
                except CaptureError as error:
                    stage.warn(f"line stereo finds nothing: {error}")
        scalp = None if mesh is None else find_scalp(mesh, envelope)
        field = self.field(envelope, with_descent(envelope, measured, bare), scalp)
        within = SHELL if o.within is None else o.within  # lines lie on the hull, millimetres off
        if head is not None and scalp is not None:
            grown = self.grown(field, scalp, seen, within)
            grown = self.refined(grown, measured, cloud, masked.cameras, depths)
            self.rooted(grown, written, scalp, head.scalp_map)
            return
        with self.report.stage("strands") as stage:
            coverage, tracing = Coverage(field), Tracing(max_length=o.max_length)
            for path in seen:
                coverage.add(path)
            gaps = fill_gaps(field, coverage, tracing, seed=o.seed, within=within)
            short = Strands.from_list([*seen, *gaps]).cut(o.max_length)
            self._unrooted(
                Strands.from_list(roots_first([short[i] for i in range(len(short))], None)),
                written,
                stage,
            )

    def envelope(
        self, masked: MaskedCapture, cloud: PointCloud, head: Mesh
    ) -> tuple[VoxelGrid, dict[str, Array]]:
        """The volume that can hold hair, and the depth `(H, W)` of each camera's hair pixels."""
        o = self.options
        with self.report.stage("envelope") as stage:
            return build_envelope(
                masked,
                cloud,
                head,
                grid=o.grid,
                margin=o.margin,
                stage=stage,
                longest=o.max_length,
            )

    def tangents(
        self, masked: MaskedCapture, cloud: PointCloud, depths: dict[str, Array]
    ) -> Measured:
        """The measured tangents."""
        with self.report.stage("orientation") as stage:
            return measure_tangents(
                masked, cloud.points, depths, self.options.measure, stage, self.progress
            )

    def surface(self, measured: Measured, cloud: PointCloud) -> list[AnyFloats]:
        """Polylines `(N, 3)` through the measured lines; none of them rooted."""
        with self.report.stage("surface") as stage:
            if not len(cloud):
                stage.leave_out(
                    "strands through the measured lines themselves",
                    "without a sweep lines lie on the visual hull, millimetres off",
                    "this stage; strands follow the field alone",
                )
                return []
            self.progress("tracing the surface", 0.0)
            o = self.options
            surface = SurfaceOptions(apart=o.measure.thin, longest=o.max_length)
            good = measured.where(measured.confidence >= LEAST_CONFIDENCE)
            polylines = surface_strands(good, surface, seed=o.seed)
            stage.figures.update(strands=len(polylines), options=asdict(surface))
        return list(polylines)

    def field(
        self, envelope: VoxelGrid, measured: Measured, scalp: Scalp | None
    ) -> OrientationField:
        """The orientation field in the envelope."""
        kept = measured.where(measured.confidence >= LEAST_CONFIDENCE)
        with self.report.stage("field") as stage:
            if not len(kept.points):
                raise CaptureError(
                    "no hair pixel has a direction: are the OLAT frames in focus and lit?"
                )
            field, series = solve_field(envelope, kept.points, kept.directions, kept.confidence)
            if series is not None:
                stage.series.append(series)
            stage.figures.update(
                unknowns=int((~field.measured).sum()),
                measured_voxels=int(field.measured.sum()),
                empty_voxels=int(field.empty.sum()),
                degenerate_voxels=int(field.degenerate.sum()),
            )
            if scalp is not None:
                stage.figures.update(scalp_cm2=scalp.area * 1e4, scalp_marked=scalp.marked)
            if field.empty.any():
                stage.warn(
                    f"{int(field.empty.sum())} voxels hang together with no measurement: left empty"
                )
        return field

    def grown(
        self,
        field: OrientationField,
        scalp: Scalp,
        seen: list[AnyFloats],
        within: float | None = None,
    ) -> Strands:
        """Strands from the scalp, then through the gaps that those leave, all of them rooted.

        Gaps are filled `within` so many metres of a measured voxel, see `fill_gaps`. `seen`
        polylines `(N, 3)` were measured as they are; they get roots like those through gaps.
        """
        o = self.options
        with self.report.stage("strands") as stage:
            roots, normals = sample_roots(scalp, o.roots, o.seed)
            self.progress("growing strands", 0.1)
            tracing = Tracing(max_length=o.max_length)
            rooted = grow_from_roots(field, roots, normals, tracing)
            coverage = Coverage(field)
            for path in rooted:
                coverage.add(path)
            share = coverage.share()
            for path in seen:
                coverage.add(path)
            self.progress("filling gaps", 0.4)
            gaps = fill_gaps(field, coverage, tracing, seed=o.seed, within=within)
            filled = coverage.share()
            self.progress("rooting strands", 0.7)
            loose = [polyline.astype(np.float32) for polyline in seen] + gaps
            result = root_all(rooted, loose, scalp)
            if not result.strands:
                raise CaptureError(
                    "no strand could be grown: the envelope does not reach the scalp"
                )
            # traced both ways and led to the scalp, they may be more than twice as long
            strands = Strands.from_list([*result.strands]).cut(o.max_length).resampled(SPACING)
            stage.figures.update(
                strands=len(strands),
                from_roots=len(rooted),
                roots_without_strand=o.roots - len(rooted),
                through_gaps=len(loose),
                gaps_led_to_scalp=result.to_scalp,
                gaps_joined_to_strand=result.joined,
                gaps_dropped=result.dropped,
                covered_by_roots=share,
                covered=filled,
                metres=float(strands.lengths().sum()),
                options=asdict(o),
            )
            if result.dropped:
                stage.warn(
                    f"{result.dropped} strands through gaps reached no root and were dropped"
                )
        return strands

    def refined(
        self,
        strands: Strands,
        measured: Measured,
        cloud: PointCloud,
        cameras: Sequence[Camera],
        depths: Mapping[str, Array],
    ) -> Strands:
        """All strands refined together by the `measured` lines, where a sweep has placed these.

        `depths` are those of each camera's hair pixels.
        """
        o = self.options.refine
        with self.report.stage("refinement") as stage:
            lines = measured.where(measured.confidence >= LEAST_CONFIDENCE)
            why = None
            if not len(cloud):
                why = "without a sweep lines lie on the visual hull, millimetres off"
            elif not len(lines.points):
                why = "no line was measured"
            elif not (o.steps or o.worth):
                why = "the options ask for none"
            if why is not None:
                stage.leave_out("refinement", why, "this stage; strands stay as they were grown")
                return strands
            self.progress("refining strands", 0.0)
            surfaces = [(camera, depths[camera.name]) for camera in cameras]
            strands, figures = refine(strands, lines, o, surfaces)
            stage.figures.update(figures)
        return strands

    def rooted(
        self, strands: Strands, measured: Measured, scalp: Scalp, flat: ScalpMap | None
    ) -> None:
        """Write strands that have roots, and where these lie on the scalp's map.

        `flat` is the head's own map where it has one.
        """
        with self.report.stage("roots") as stage:
            strands = replace(strands, radius=self._radius(len(strands)))
            self._write(strands, measured, stage)
            write_root_map(self.model, strands, scalp, flat, stage)

    def _write(self, strands: Strands, measured: Measured, stage: Stage) -> None:
        """Write strands, each point with its confidence by the `measured` lines."""
        lines = measured.where(measured.confidence >= LEAST_CONFIDENCE)
        confidence = supported(strands, lines)
        stage.figures.update(
            strands=len(strands),
            metres=float(strands.lengths().sum()),
            radius=strands.radius,
            measured_share=float((confidence > 0).mean()),
        )
        self.model.write_strands(replace(strands, confidence=confidence))

    def _radius(self, count: int) -> float:
        """Metres: the user's, or what keeps a head of hair's coverage with so many strands."""
        return self.options.radius or float(np.clip(HEAD_OF_HAIR / max(count, 1), 4e-5, 4e-4))

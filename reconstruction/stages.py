"""The stages of a reconstruction that measure: points, masks, envelope, tangents, lines.

Each stage times itself and leaves its figures and warnings in the report.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Literal, TypeVar

from reconstruction.arrays import AnyFloats, Array
from reconstruction.capture.folder import Capture
from reconstruction.capture.records import origin
from reconstruction.capture_scale import CaptureScale
from reconstruction.geometry.mesh import Mesh
from reconstruction.geometry.voxels import VoxelGrid
from reconstruction.growth.hair_envelope import build_envelope
from reconstruction.growth.surface_strands import SurfaceOptions, surface_strands
from reconstruction.head.capture_head import FittedHead
from reconstruction.images.faint_parts import faint_warnings
from reconstruction.light_codes.line_strands import line_strands
from reconstruction.light_codes.segments import Segments
from reconstruction.light_planes import Motion, PointCloud, solve_motion, sweep_peaks, triangulate
from reconstruction.masks import MaskedCapture, hair_masks, report_agreement, usable_masks
from reconstruction.methods import Method
from reconstruction.model import Model
from reconstruction.reconstruct_options import ReconstructOptions
from reconstruction.report.progress import part_of
from reconstruction.report.report import Progress, Report, Stage
from reconstruction.tangents.estimate import Measured, measure_tangents

_COARSE = 8e-3  # metres: voxels of a hull that only measures the distance
LEAST_CONFIDENCE = 0.1  # of a measured tangent to count


def method_for(capture: Capture) -> Method:
    """The method of `auto`: planes of light for a sweep and single lights, else the hull."""
    return "light_planes" if capture.of_kind("scanline") and capture.olat_lights() else "hull"


@dataclass(frozen=True)
class Stages:
    """What all stages of a reconstruction share."""

    model: Model
    options: ReconstructOptions
    progress: Progress
    report: Report

    def as_kind(self, kind: type[S]) -> S:
        """These as other stages of the same reconstruction."""
        return kind(self.model, self.options, self.progress, self.report)


S = TypeVar("S", bound=Stages)


class MeasuringStages(Stages):
    """The stages that measure."""

    def imported(self, capture: Capture) -> None:
        """The notes of the import, if the capture was imported, and the motion taken off it."""
        if notes := capture.plan.get("import"):
            with self.report.stage("import") as stage:
                stage.figures["relative_units"] = bool(notes["relative"])
                for note in notes["notes"]:
                    stage.warn(note)

        if motion := capture.plan.get("stabilised"):
            with self.report.stage("stabilised") as stage:
                stage.figures |= {k: v for k, v in motion.items() if k != "motion"}

        if noise := capture.plan.get("demultiplexed"):
            with self.report.stage("demultiplexed") as stage:
                stage.figures["condition"] = noise["condition"]
                for kind in ("read_noise_gain", "photon_noise_gain"):
                    stage.figures[f"largest_{kind}"] = max(noise[kind].values())

    def undistorted(self, capture: Capture) -> Capture:
        """The capture through pinholes; the stage "lenses" has the share of pixels kept."""
        self.report.drop("lenses")
        if not any(c.distorted for c in capture.rig.cameras):
            return capture
        with self.report.stage("lenses") as stage:
            out = capture.view(undistorted=True)
            kept = {name: lens.kept() for name, lens in out.lenses.items()}
            stage.figures["pixels_kept"] = kept
            for name, share in kept.items():
                if share < 0.85:
                    stage.warn(f"{name}: {1 - share:.0%} of the image is lost by undistortion")
        return out

    def chosen(self, capture: Capture, head: FittedHead | None) -> Method:
        """The method of `auto`, recorded in the stage `method`."""
        with self.report.stage("method") as stage:
            sweep, lights = bool(capture.of_kind("scanline")), len(capture.olat_lights())
            method = method_for(capture)
            holds = f"{'a' if sweep else 'no'} sweep, {lights} single lights, "
            if capture.patterns is not None:
                holds += f"{len(capture.patterns.names)} patterns of lights, "
            elif capture.without_single_lights():
                holds += f"{len(capture.rig.cameras)} photographs under constant light, "
            holds += f"{'no' if head is None else 'a'} head"
            stage.figures.update(method=method, capture_holds=holds)
            self.progress(f"{holds}: method {method}", 0.0)
        return method

    def points(self, capture: Capture, motion: Motion | None) -> PointCloud:
        """Triangulated points in the reference pose; none without a sweep."""
        rig = capture.rig
        with self.report.stage("triangulation") as stage:
            if capture.of_kind("scanline"):
                cloud = self._triangulated(capture, motion, stage)
            else:
                why = "no sweep was captured" if rig.projectors else "the rig has no projector"
                stage.leave_out("triangulation and motion", why, "the scanline sweep and its solve")
                cloud = PointCloud.empty(
                    tuple(c.name for c in rig.cameras), tuple(p.name for p in rig.projectors)
                )
            self.model.write_points(cloud)
        return cloud

    def _triangulated(self, capture: Capture, motion: Motion | None, stage: Stage) -> PointCloud:
        progress, options = self.progress, self.options.motion
        peaks = sweep_peaks(capture, part_of(progress, 0.0, 0.8))
        if motion is None:
            still = Stage(stage.name)
            first = triangulate(capture, peaks=peaks, stage=still)
            with self.report.stage("motion") as solving:
                motion = solve_motion(
                    capture, first, options=options, progress=progress, stage=solving
                )
            if motion.still:
                stage.take(still)
                return first
        known = None if motion.still else motion
        return triangulate(capture, motion=known, peaks=peaks, progress=progress, stage=stage)

    def masks(
        self, whole: Capture, capture: Capture, cloud: PointCloud, head: FittedHead | None
    ) -> MaskedCapture:
        """Masks of all cameras of `whole` are written, those of `capture` used.

        A held-out camera's mask is only used to compare images.
        """
        with self.report.stage("masks") as stage:
            mesh = None if head is None else head.mesh
            every = hair_masks(whole, cloud if len(cloud) else None, mesh)
            for name, mask in every.items():
                self.model.write_mask(name, "hair", whole.mask_as_shot(name, mask.hair))
                self.model.write_mask(name, "skin", whole.mask_as_shot(name, mask.skin))
            report_agreement(whole, every, cloud, mesh, stage)
            for warning in faint_warnings(capture, {k: m.subject for k, m in every.items()}):
                stage.warn(warning)
            masks = usable_masks(capture, every, stage)
            stage.figures["hair_pixels"] = {k: int(m.hair.sum()) for k, m in masks.items()}
            stage.figures["source"] = {k: m.source for k, m in masks.items()}
            stage.figures["capture"] = origin(whole.plan)
        return MaskedCapture(capture, masks)

    def lines(
        self, masked: MaskedCapture, head: FittedHead | None, method: Literal["photometric", "lmvs"]
    ) -> tuple[list[AnyFloats], Segments]:
        """Polylines `(N, 3)` from line stereo, and their segments."""
        options, mesh = self.options.light_codes, None if head is None else head.mesh
        return line_strands(
            masked, mesh, self.report, method=method, options=options, progress=self.progress
        )

    def scale(
        self, masked: MaskedCapture, cloud: PointCloud, head: FittedHead | None
    ) -> CaptureScale:
        """The lengths that the capture resolves: at its points, else at the head or the hull."""
        with self.report.stage("scale") as stage:
            if len(cloud):
                at: AnyFloats = cloud.points
            elif head is not None:
                at = head.mesh.vertices
            else:
                at = masked.subject_hull(_COARSE).centers()
            scale = CaptureScale.of(masked.cameras, at, self.options)
            stage.figures.update(scale.figures())
            self.progress(scale.resolution, 0.0)
        return scale

    def envelope(
        self, masked: MaskedCapture, cloud: PointCloud, head: Mesh, scale: CaptureScale
    ) -> tuple[VoxelGrid, dict[str, Array]]:
        """The volume that can contain hair, and the depth `(H, W)` of each camera's hair pixels."""
        o = self.options
        with self.report.stage("envelope") as stage:
            return build_envelope(
                masked,
                cloud,
                head,
                grid=scale.grid,
                margin=scale.margin,
                stage=stage,
                longest=o.max_length,
            )

    def tangents(
        self,
        masked: MaskedCapture,
        cloud: PointCloud,
        depths: dict[str, Array],
        scale: CaptureScale,
    ) -> Measured:
        """The measured tangents."""
        with self.report.stage("orientation") as stage:
            return measure_tangents(
                masked, cloud, depths, scale, self.options.measure, stage, self.progress
            )

    def surface(self, measured: Measured, cloud: PointCloud) -> list[AnyFloats]:
        """Unrooted polylines `(N, 3)` through the measured lines."""
        with self.report.stage("surface") as stage:
            if not len(cloud):
                stage.leave_out(
                    "strands through the measured lines",
                    "without a sweep lines lie on the visual hull, millimetres off",
                    "this stage; strands follow the field alone",
                )
                return []
            self.progress("tracing the surface", 0.0)
            o = self.options
            surface = SurfaceOptions(apart=measured.apart, longest=o.max_length)
            good = measured.where(measured.confidence >= LEAST_CONFIDENCE)
            polylines = surface_strands(good, surface, seed=o.seed)
            stage.figures.update(strands=len(polylines), options=asdict(surface))
        return list(polylines)

"""From a capture folder to strands: the methods, as sequences of stages."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

from reconstruction.arrays import AnyFloats
from reconstruction.capture.folder import Capture
from reconstruction.capture.frame_cache import cached_frames
from reconstruction.capture.records import CaptureError
from reconstruction.geometry.mesh_queries import inside_mesh
from reconstruction.geometry.strands import Strands
from reconstruction.growing import GrowingStages
from reconstruction.growth.field import with_descent
from reconstruction.growth.from_roots import Coverage, Tracing, fill_gaps
from reconstruction.growth.hair_envelope import SHELL, build_hull
from reconstruction.head.capture_head import FittedHead
from reconstruction.head.heads import Heads
from reconstruction.head.scalp import find_scalp
from reconstruction.light_codes.line_strands import SEGMENT_WEIGHT, merge, roots_first
from reconstruction.light_planes import Motion, PointCloud
from reconstruction.masks import MaskedCapture
from reconstruction.methods import METHODS, Method
from reconstruction.model import Model
from reconstruction.reconstruct_options import ReconstructOptions
from reconstruction.report.progress import ReportWithProgress
from reconstruction.report.report import Progress, Report, silent
from reconstruction.stages import MeasuringStages, Stages, method_for
from reconstruction.tangents.estimate import MOST_DEVIATION, Measured

FINE_PIXEL = 1e-3  # metres: line stereo fails on pixels twice as wide

_SURFACE, _GROWN = ("scale", "envelope", "orientation"), ("field", "strands", "refinement")
_LINES = ("lightcodes", "depth", "segments", "connection")
STAGES: dict[str, tuple[str, ...]] = {
    "light_planes": ("triangulation", "masks", *_SURFACE, "surface", *_GROWN, "hidden", "roots"),
    "fused": ("triangulation", "masks", *_SURFACE, "surface", *_LINES, *_GROWN, "hidden", "roots"),
    "photometric": ("triangulation", "masks", *_LINES, "strands"),
    "lmvs": ("triangulation", "masks", *_LINES, "strands"),
    "hull": ("masks", *_SURFACE, *_GROWN, "roots"),
}
"""The expected stages of each method, for the progress."""


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

    `motion` is the subject's, if known; None solves for it.

    Writes `strands.npz`, `strands.hair`, `strands.usdc`, `points.npz`, `scalp_map.npz`,
    `masks/*.png`, `head.obj` if the capture has none, and `report.json`; results from the model's
    earlier strands are removed. `hull` needs masks and two cameras only; `auto` is `light_planes`
    for a capture with a sweep, else `hull`, recorded in the stage `method`. Raises `CaptureError`
    if the capture lacks what the method requires (OLAT frames, a head or points to fit one to, two
    cameras), or if no strand is found.
    """
    if method not in METHODS:
        raise ValueError(f"unknown method {method!r}; there are {', '.join(METHODS)}")
    expected = STAGES[method_for(capture) if method == "auto" else method]
    report = ReportWithProgress(progress, expected)
    model.create()
    with cached_frames(capture, model.path) as kept:
        model.start(capture.world if options.frame == "user" else None)
        run = _Run(Stages(model, options, report.progress, report), kept)
        run.reconstruct(method, motion)
    if not any(stage.name == "head" for stage in report.stages):
        model.remove("head.obj")  # of an earlier reconstruction
    model.write_report(report)
    progress("strands reconstructed", 1.0)
    return report


def without(capture: Capture, cameras: tuple[str, ...]) -> Capture:
    """The capture without these cameras.

    Raises `KeyError` for an unknown one, `CaptureError` if fewer than two are left.
    """
    for name in cameras:
        capture.rig.camera(name)
    left = [c.name for c in capture.rig.cameras if c.name not in cameras]
    if len(left) < 2:
        raise CaptureError(f"{capture.path}: {len(left)} cameras are left, at least 2 are needed")
    return capture.view(cameras=left)


@dataclass(frozen=True)
class _Run:
    """The sequences of stages of the methods."""

    stages: Stages
    capture: Capture

    @cached_property
    def measuring(self) -> MeasuringStages:
        return self.stages.as_kind(MeasuringStages)

    @cached_property
    def growing(self) -> GrowingStages:
        return self.stages.as_kind(GrowingStages)

    def reconstruct(self, method: Method, motion: Motion | None) -> None:
        """Run the stages of `method`; see `reconstruct`."""
        measuring, growing, options = self.measuring, self.growing, self.stages.options
        measuring.imported(self.capture)
        whole = measuring.undistorted(self.capture)
        capture = without(whole, options.held_out)
        heads = Heads(self.stages.model, options, self.stages.progress, self.stages.report)
        head = heads.known(capture)
        if method == "auto":
            method = measuring.chosen(capture, head)
        cloud = measuring.points(capture, motion)
        masked = measuring.masks(whole, capture, cloud, head)
        if method == "photometric" or method == "lmvs":
            self.line_stereo(masked, head, method)
        elif method == "hull":
            self.hull(masked, cloud, head or heads.fit_by_shading(masked))
        else:
            head = head or heads.fit_to_skin_points(masked, cloud)
            if not capture.olat_lights():
                raise CaptureError(
                    f"{capture.path}: no OLAT frames, which the method '{method}' needs: run "
                    "'hairstage demultiplex' first where patterns determine the lights, or use "
                    "'hull', which takes photographs under constant light and patterns"
                )
            scale = measuring.scale(masked, cloud, head)
            envelope, depths = measuring.envelope(masked, cloud, head.mesh, scale)
            measured = measuring.tangents(masked, cloud, depths, scale)
            polylines, lines = measuring.surface(measured, cloud), measured
            if method == "fused":
                more, segments = measuring.lines(masked, head, "photometric")
                polylines += more
                lines = merge(measured, segments)
                measured = merge(measured, segments, SEGMENT_WEIGHT)
            scalp = find_scalp(head.mesh, envelope)
            field = growing.field(envelope, measured, scalp)
            grown = growing.grown(field, scalp, polylines, options.within)
            strands = growing.refined(
                grown.strands, measured, cloud, masked.cameras, depths, scale.grid
            )
            rooted = scalp if grown.rooted else None
            strands = growing.with_hidden(
                strands,
                rooted,
                envelope,
                cloud,
                [(camera, depths[camera.name]) for camera in masked.cameras],
                scale.pixel,
            )
            growing.rooted(strands, lines, rooted, head.scalp_map)

    def line_stereo(
        self, masked: MaskedCapture, head: FittedHead | None, method: Literal["photometric", "lmvs"]
    ) -> None:
        """Unrooted strands from line stereo alone."""
        polylines, segments = self.measuring.lines(masked, head, method)
        with self.stages.report.stage("strands") as stage:
            stage.leave_out(
                "roots",
                "line stereo measures visible hair; the method 'fused' connects it to the scalp",
                "the field and the growth",
            )
            lines = Measured(segments.points, segments.directions, segments.confidence)
            strands = Strands.from_list(polylines).cut(self.stages.options.max_length)
            self.growing.unrooted(strands, lines, stage)

    def hull(self, masked: MaskedCapture, cloud: PointCloud, head: FittedHead | None) -> None:
        """Strands along the smooth field of the hull's surface and all measured lines.

        Single lights, photographs under constant light or patterns give directions. Line stereo
        adds lines if pixels are at most `FINE_PIXEL` wide and directions are uncertain: where they
        are certain the cameras agree on the hull's surface, and lines beside it are often wrong.
        Without light nothing is measured; without a head no strand has a root.
        """
        o, capture, report = self.stages.options, masked.capture, self.stages.report
        lit = bool(capture.olat_lights() or capture.without_single_lights())
        mesh = None if head is None else head.mesh
        scale = self.measuring.scale(masked, cloud, head)
        if mesh is None:
            with report.stage("envelope") as stage:
                envelope, bare, depths = build_hull(masked, grid=scale.grid, stage=stage)
        else:
            envelope, depths = self.measuring.envelope(masked, cloud, mesh, scale)
            bare = inside_mesh(envelope, mesh)
        measured, polylines = Measured.none(), list[AnyFloats]()
        if lit:
            measured = self.measuring.tangents(masked, cloud, depths, scale)
        written = measured
        with report.stage("line stereo") as stage:
            if not lit:
                stage.warn("no lit frames: nothing is measured, all strands are guessed")
            elif scale.pixel > FINE_PIXEL:
                why = (
                    f"a pixel is {1e3 * scale.pixel:.1f} mm wide, more than {1e3 * FINE_PIXEL:g} mm"
                )
                stage.leave_out("line stereo", why, "its stages")
            elif measured.deviation <= MOST_DEVIATION:
                why = (
                    f"directions on the hull are certain to {measured.deviation:.0f}° in the median"
                )
                stage.leave_out("line stereo", why, "its stages")
            else:
                try:
                    lines, segments = self.measuring.lines(masked, head, "photometric")
                    polylines, written = list(lines), merge(measured, segments)
                    measured = merge(measured, segments, SEGMENT_WEIGHT)
                except CaptureError as error:
                    stage.warn(f"line stereo found nothing: {error}")
        scalp = None if mesh is None else find_scalp(mesh, envelope)
        field = self.growing.field(envelope, with_descent(envelope, measured, bare), scalp)
        within = SHELL if o.within is None else o.within  # lines lie on the hull, millimetres off
        if head is not None and scalp is not None:
            grown = self.growing.grown(field, scalp, polylines, within)
            strands = self.growing.refined(
                grown.strands, measured, cloud, masked.cameras, depths, scale.grid
            )
            self.growing.rooted(strands, written, scalp if grown.rooted else None, head.scalp_map)
            return
        with report.stage("strands") as stage:
            coverage, tracing = Coverage(field), Tracing(max_length=o.max_length)
            for path in polylines:
                coverage.add(path)
            gaps = fill_gaps(field, coverage, tracing, seed=o.seed, within=within)
            short = Strands.from_list([*polylines, *gaps]).cut(o.max_length)
            paths = roots_first([short[i] for i in range(len(short))], None)
            self.growing.unrooted(Strands.from_list(paths), written, stage)

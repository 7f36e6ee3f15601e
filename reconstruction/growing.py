"""The stages of a reconstruction that grow strands: field, growth, refinement, roots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from reconstruction.arrays import AnyFloats, Array
from reconstruction.capture.records import CaptureError
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.strands import Strands
from reconstruction.geometry.voxels import VoxelGrid
from reconstruction.growth.field import OrientationField, solve_field
from reconstruction.growth.from_roots import Coverage, Tracing, fill_gaps, grow_from_roots
from reconstruction.growth.hidden import hidden_strands, measured_density, seen_by
from reconstruction.growth.lines import Surfaces
from reconstruction.growth.refinement import refine, supported
from reconstruction.growth.rooting import root_all
from reconstruction.growth.thickness import covering_radii
from reconstruction.head.scalp import Scalp, sample_roots
from reconstruction.head.scalp_map import ScalpMap, write_root_map
from reconstruction.light_codes.line_strands import roots_first
from reconstruction.light_planes import PointCloud
from reconstruction.plausibility import check_face, check_inside, check_strands, usual_hairs
from reconstruction.report.report import Stage
from reconstruction.stages import LEAST_CONFIDENCE, Stages
from reconstruction.tangents.estimate import Measured
from reconstruction.tangents.point_lines import WIDEST_PIXEL

SPACING = 2e-3  # metres between a written strand's points
SURE = 4.0  # voxels from a measured line within which the depth of hair is taken as measured


@dataclass(frozen=True)
class Grown:
    """Strands, and whether they have roots on the scalp."""

    strands: Strands
    rooted: bool


class GrowingStages(Stages):
    """The stages that grow strands along the measured lines, and write them."""

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
                    f"{int(field.empty.sum())} voxels stay empty: no measurement is connected"
                )
        return field

    def grown(
        self,
        field: OrientationField,
        scalp: Scalp,
        measured: list[AnyFloats],
        within: float | None = None,
    ) -> Grown:
        """Strands from the scalp, then through the gaps between them, all rooted.

        `measured` polylines `(N, 3)` and those through gaps are rooted alike. None has a root where
        cameras show the scalp of too few (`Rooted.reaches`), as of the end of a tail.
        `within` in metres: see `fill_gaps`.
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
            for path in measured:
                coverage.add(path)
            self.progress("filling gaps", 0.4)
            gaps = fill_gaps(field, coverage, tracing, seed=o.seed, within=within)
            filled = coverage.share()
            self.progress("rooting strands", 0.7)
            loose = [polyline.astype(np.float32) for polyline in measured] + gaps
            result = root_all(rooted, loose, scalp)
            reached = result.reaches
            paths = result.strands if reached else roots_first([*rooted, *loose], None)
            if not paths:
                raise CaptureError(
                    "no strand could be grown: the envelope does not reach the scalp"
                )
            # traced both ways and connected to the scalp, they may be twice as long
            strands = Strands.from_list([*paths]).cut(o.max_length).resampled(SPACING)
            stage.figures.update(
                strands=len(strands),
                from_roots=len(rooted),
                roots_without_strand=o.roots - len(rooted),
                through_gaps=len(loose),
                gaps_led_to_scalp=result.to_scalp,
                gaps_joined_to_strand=result.joined,
                gaps_dropped=result.dropped if reached else 0,
                covered_by_roots=share,
                covered=filled,
                metres=float(strands.lengths().sum()),
                options=asdict(o),
            )
            if result.dropped or not reached:
                away = result.dropped if reached else result.dropped + result.joined + result.led
                consequence = "and were removed" if reached else "so that no strand is rooted"
                stage.warn(
                    f"{away} of {len(rooted) + len(loose)} strands could not be connected to the "
                    f"scalp, {consequence}"
                )
        return Grown(strands, reached)

    def refined(
        self,
        strands: Strands,
        measured: Measured,
        cloud: PointCloud,
        cameras: Sequence[Camera],
        depths: Mapping[str, Array],
        grid: float,
    ) -> Strands:
        """Strands refined jointly by the `measured` lines, if there is a sweep.

        `depths (H, W)` are those of each camera's hair pixels, `grid` is the envelope's, metres.
        """
        o = self.options.refine
        with self.report.stage("refinement") as stage:
            lines = measured.where(measured.confidence >= LEAST_CONFIDENCE)
            why = None
            if not len(cloud):
                why = "without a sweep lines lie on the visual hull, millimetres off"
            elif not len(lines.points):
                why = "no line was measured"
            elif not (o.steps or o.marginal_coverage):
                why = "the options disable it"
            if why is not None:
                stage.leave_out("refinement", why, "this stage; strands stay as grown")
                return strands
            self.progress("refining strands", 0.0)
            surfaces = [(camera, depths[camera.name]) for camera in cameras]
            strands, figures = refine(strands, lines, o, surfaces, lines.apart, SURE * grid)
            stage.figures.update(figures)
        return strands

    def with_hidden(
        self,
        strands: Strands,
        scalp: Scalp | None,
        envelope: VoxelGrid,
        cloud: PointCloud,
        surfaces: Surfaces,
        pixel: float,
    ) -> Strands:
        """`strands`, and copies of them where the `envelope` holds hair that no camera sees.

        Rooted where there is a `scalp`; `pixel` is the width of one on the hair, metres.
        """
        o = self.options
        with self.report.stage("hidden") as stage:
            density, why = None, self._unknown_density(cloud, pixel)
            if why is None:
                density = measured_density(cloud.points, o.hidden_density, o.seed)
                why = "too few points lie close together"
            if density is None:
                stage.leave_out("hair that no camera sees", why, "this stage")
                return strands
            self.progress("filling hidden hair", 0.0)
            own = [strands[i] for i in range(len(strands))]
            hairs = usual_hairs(None if scalp is None else scalp.area)
            more, figures = hidden_strands(
                strands,
                envelope,
                density,
                seen_by(surfaces, cloud, strands, density.depth),
                most=hairs - len(own),
                seed=o.seed,
            )
            if len(own) + len(more) >= hairs:
                stage.leave_out(
                    f"{figures['still_missing_metres']:.0f} m of hidden hair",
                    f"there are as many strands as the {hairs} hairs of "
                    + ("a head" if scalp is None else "the scalp"),
                    "strands",
                )
            if scalp is not None:
                more = root_all(own, more, scalp).strands[len(own) :]
            out = Strands.from_list([*own, *more]).cut(o.max_length).resampled(SPACING)
            stage.figures.update(figures, strands=len(out), metres=float(out.lengths().sum()))
        return out

    def _unknown_density(self, cloud: PointCloud, pixel: float) -> str | None:
        """Why the density of hidden hair is unknown, None if it is not."""
        if self.options.hidden_density == 0:
            return "the options disable it"
        if not len(cloud):
            return "without a sweep nothing shows how far light gets into the hair"
        if pixel > WIDEST_PIXEL and self.options.hidden_density is None:
            return (
                f"pixels of {1e3 * pixel:.2g} mm are wider than {1e3 * WIDEST_PIXEL:.2g} mm and do "
                "not show how far light gets into the hair; option: hidden_density"
            )
        return None

    def rooted(
        self, strands: Strands, measured: Measured, scalp: Scalp | None, flat: ScalpMap | None
    ) -> None:
        """Write rooted strands, and their roots on the scalp's map; `flat` is the head's own.

        Without a `scalp` no strand has a root.
        """
        with self.report.stage("roots") as stage:
            if scalp is None:
                why = "the hair that cameras show does not reach the scalp"
                stage.leave_out("roots", why, "this stage; strands begin at their higher end")
                self.unrooted(strands, measured, stage)
                return
            self._write(strands, measured, stage, scalp.area)
            check_face(strands, scalp.head, stage)
            check_inside(strands, scalp.head, stage)
            write_root_map(self.model, strands, scalp, flat, stage)

    def unrooted(self, strands: Strands, measured: Measured, stage: Stage) -> None:
        """Write strands without roots; raises `CaptureError` without strands."""
        if not len(strands):
            raise CaptureError("no strand was found: use the method 'hull', which fills the masks")
        self._write(strands, measured, stage)

    def _write(
        self, strands: Strands, measured: Measured, stage: Stage, area: float | None = None
    ) -> None:
        """Write strands, each point with its radius, and its confidence by the `measured` lines."""
        strands = replace(strands, radius=self.options.radius or covering_radii(strands))
        lines = measured.where(measured.confidence >= LEAST_CONFIDENCE)
        confidence = supported(strands, lines)
        stage.figures.update(
            strands=len(strands),
            metres=float(strands.lengths().sum()),
            radius=float(np.median(strands.radius)),
            measured_share=float((confidence > 0).mean()),
        )
        check_strands(strands, area, stage)
        self.model.write_strands(replace(strands, confidence=confidence))

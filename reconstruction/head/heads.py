"""Which head strands grow from: the user's, the capture's, or a template under what shows."""

from __future__ import annotations

from dataclasses import dataclass

from reconstruction.capture.folder import Capture, CaptureError
from reconstruction.head.capture_head import (
    FittedHead,
    HeadPoints,
    digitised_points,
    fit_capture_head,
    lit_skin_points,
    skin_points,
)
from reconstruction.head.lit_skin import FEWEST_LIGHTS
from reconstruction.light_planes.point_cloud import PointCloud
from reconstruction.masks import MaskedCapture
from reconstruction.model import Model
from reconstruction.reconstruct_options import ReconstructOptions
from reconstruction.report.report import Progress, Report

UNLIKE_MM = 3.0  # RMS from a face's points to the posed template's: of another head it has 5


@dataclass(frozen=True)
class Heads:
    """The ways to a head; each leaves it in `model`, and the stage `head` in the report."""

    model: Model
    options: ReconstructOptions
    progress: Progress
    report: Report

    def known(self, capture: Capture) -> FittedHead | None:
        """The head under the user's scalp points, which win where asked for, or the capture's."""
        self.report.drop("head")
        asked = self.options.scalp_points
        if capture.head is not None and asked is None:
            return FittedHead(capture.head, None)
        points = digitised_points(capture, asked)
        return None if points is None else self._fitted(points)

    def under_skin(self, masked: MaskedCapture, cloud: PointCloud) -> FittedHead:
        """The head under the triangulated points on bare skin."""
        return self._fitted(skin_points(masked, cloud), cloud)

    def by_light(self, masked: MaskedCapture) -> FittedHead | None:
        """The head under skin whose shape single lights show, None where they show none."""
        lights = masked.capture.olat_lights()
        if len(lights) < FEWEST_LIGHTS or not any(m.skin.any() for m in masked.masks.values()):
            return None
        with self.report.stage("head") as stage:
            self.progress("looking for a face", 0.0)
            try:
                points = lit_skin_points(masked, masked.subject_hull(self.options.grid))
                seed = self.options.seed
                head = fit_capture_head(points, self.options.head_mesh, stage, seed=seed)
                off = stage.figures["posed_rms_mm"]
                if off > UNLIKE_MM:
                    raise CaptureError(
                        f"the face is {off:.1f} mm off the template's, more than {UNLIKE_MM:g}"
                    )
            except CaptureError as error:
                stage.warn(
                    f"no head is taken from single lights, no strand has a root: {error}: give "
                    "head.obj, or scalp points as scalp.obj"
                )
                self.model.remove("head.obj")
                return None
            self.progress(f"head: a template under {points.source}", 0.0)
            self.model.write_head(head.mesh)
        return head

    def _fitted(self, points: HeadPoints, cloud: PointCloud | None = None) -> FittedHead:
        with self.report.stage("head") as stage:
            seed = self.options.seed
            head = fit_capture_head(points, self.options.head_mesh, stage, cloud=cloud, seed=seed)
            self.model.write_head(head.mesh)
        return head

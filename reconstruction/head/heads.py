"""The head that strands grow from: the user's, the capture's, or a fitted template."""

from __future__ import annotations

from dataclasses import dataclass

from reconstruction.capture.folder import Capture
from reconstruction.capture.records import CaptureError
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

_HULL_GRID = 2e-3  # metres
UNLIKE_MM = 3.0  # RMS of a face's points from the posed template; another head has 5


@dataclass(frozen=True)
class Heads:
    """Sources of a head; each writes it to `model` and the stage `head` to the report."""

    model: Model
    options: ReconstructOptions
    progress: Progress
    report: Report

    def known(self, capture: Capture) -> FittedHead | None:
        """The capture's head, unless `scalp_points` is given, else one fitted to scalp points."""
        self.report.drop("head")
        file = self.options.scalp_points
        if capture.head is not None and file is None:
            return FittedHead(capture.head, None)
        points = digitised_points(capture, file)
        return None if points is None else self._fitted(points)

    def fit_to_skin_points(self, masked: MaskedCapture, cloud: PointCloud) -> FittedHead:
        """The head fitted to triangulated points on bare skin."""
        return self._fitted(skin_points(masked, cloud), cloud)

    def fit_by_shading(self, masked: MaskedCapture) -> FittedHead | None:
        """The head fitted to skin by photometric stereo, None if that fails."""
        lights = masked.capture.olat_lights()
        if len(lights) < FEWEST_LIGHTS or not any(m.skin.any() for m in masked.masks.values()):
            return None
        with self.report.stage("head") as stage:
            self.progress("fitting a head to the face", 0.0)
            try:
                grid = self.options.grid or _HULL_GRID
                points = lit_skin_points(masked, masked.subject_hull(grid))
                seed = self.options.seed
                head = fit_capture_head(points, self.options.head_mesh, stage, seed=seed)
                off = stage.figures["posed_rms_mm"]
                if off > UNLIKE_MM:
                    raise CaptureError(
                        f"the face is {off:.1f} mm RMS from the template, limit {UNLIKE_MM:g} mm"
                    )
            except CaptureError as error:
                stage.warn(
                    f"no head could be fitted, strands have no roots: {error}; provide head.obj, "
                    "or scalp points as scalp.obj"
                )
                self.model.remove("head.obj")
                return None
            self.progress(f"head: template fitted to {points.source}", 0.0)
            self.model.write_head(head.mesh)
        return head

    def _fitted(self, points: HeadPoints, cloud: PointCloud | None = None) -> FittedHead:
        with self.report.stage("head") as stage:
            seed = self.options.seed
            head = fit_capture_head(points, self.options.head_mesh, stage, cloud=cloud, seed=seed)
            self.model.write_head(head.mesh)
        return head

"""The light-plane method on subjects whose truth is known: quality, shares, motion, run times."""

from __future__ import annotations

import json
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np

from benchmarks.light_planes.growth_study import compare_growth
from benchmarks.light_planes.motion_errors import motion_errors, true_motion
from benchmarks.light_planes.stage_costs import of_field, of_strands, of_triangulation
from benchmarks.pictures import picture_model, picture_motion
from reconstruction.arrays import AnyFloats, Floats
from reconstruction.capture.folder import Capture
from reconstruction.evaluation.baselines import baseline_hull, hull_smooth_field, hull_vertical
from reconstruction.evaluation.matching import compare_strands
from reconstruction.evaluation.visibility import Visibility
from reconstruction.files.strands import read_strands
from reconstruction.geometry.strands import Strands
from reconstruction.growth.field import field_system, solve_field
from reconstruction.growth.hair_envelope import build_envelope
from reconstruction.growth.laplace import compare_solvers
from reconstruction.head.scalp import find_scalp, sample_roots
from reconstruction.light_planes import (
    Motion,
    MotionOptions,
    PointCloud,
    solve_motion,
    sweep_peaks,
    triangulate,
)
from reconstruction.masks import HairMask
from reconstruction.model import Model
from reconstruction.pipeline import ReconstructOptions, reconstruct
from reconstruction.report.plots import plot_report
from reconstruction.report.report import Progress, Report, Stage, silent
from reconstruction.tangents.estimate import measure_tangents

PAPER = {
    "side_responses": "75 % of bright pixels",
    "culled_by_hull": "2 % of points",
    "filled_in": "30 to 70 % of the field",
}
"""Photobooth's own shares (§3.1, §3.3)."""

SUN = {"short": (22.4, 59.2, 79.4), "long": (28.2, 65.5, 80.6)}
"""F in per cent that Sun et al. 2021 print for their method, at the three thresholds."""


METHODS: tuple[Literal["registered", "direct"], ...] = ("registered", "direct")


@dataclass(frozen=True)
class Case:
    """One subject: its capture while still, the one while drifting, and the truth of each."""

    still: tuple[Path, Path]
    drifting: tuple[Path, Path] | None = None


class Truth:
    """What strands are scored against: true strands, head, and what the cameras see of them."""

    def __init__(self, capture: Capture, folder: Path) -> None:
        self._strands = read_strands(folder / "strands.npz")
        self._capture = capture
        self._visibility = Visibility(capture.rig.cameras, self._strands, capture.head)

    @property
    def points(self) -> Floats:
        """Of the true strands `(N, 3)`."""
        return self._strands.points

    def score(self, strands: Strands) -> dict[str, Any]:
        """`compare_strands` over visible and all."""
        return compare_strands(
            strands,
            self._strands,
            cameras=self._capture.rig.cameras,
            head=self._capture.head,
            visibility=self._visibility,
        )


def subject(
    out: Path,
    case: Case,
    options: ReconstructOptions,
    *,
    studies: bool = False,
    progress: Progress = silent,
) -> dict[str, Any]:
    """One subject, still and drifting, and the baselines; leaves models and `OUT/result.json`.

    `studies` adds what one subject is enough for: the motion's worth in strands, error against run
    time of motion, field and growth, and how stages grow.
    """
    capture = Capture(case.still[0])
    truth = Truth(capture, case.still[1])
    rows: dict[str, Any] = {}
    rows["still"], report = _ours(capture, truth, out / "still", options, progress)
    picture_model(
        out / "still.png",
        capture,
        PointCloud.load(out / "still" / "points.npz"),
        read_strands(out / "still" / "strands.npz"),
    )
    for name, baseline in _baselines(capture, out / "still").items():
        rows[name] = truth.score(baseline)
    result: dict[str, Any] = {
        "scores": rows,
        "shares": _shares(report),
        "stages": {s.name: {"seconds": s.seconds, "peak_gb": s.peak_gb} for s in report.stages},
    }
    if case.drifting is not None:
        moving = Capture(case.drifting[0])
        known = true_motion(moving, case.drifting[1])
        # the simulator moves its subject at tracking frames only
        held = replace(options, motion=replace(options.motion, between="hold"))
        rows["drifting"], _ = _ours(moving, truth, out / "drifting", held, progress)
        if studies:
            none = Motion.none(known.steps)
            for name, motion in (("true motion", known), ("no motion", none)):
                model = out / name.replace(" ", "_")
                rows[name], _ = _ours(moving, truth, model, held, progress, motion)
            models = {"no compensation": "no_motion", "compensated": "drifting", "still": "still"}
            clouds = {k: PointCloud.load(out / v / "points.npz") for k, v in models.items()}
            picture_motion(out / "motion.png", clouds)
        result["motion"] = motion_study(moving, truth.points[::50], known, progress)
    if studies:
        result["series"], result["growth"] = _studies(capture, out / "still", options, progress)
    out.mkdir(parents=True, exist_ok=True)
    (out / "result.json").write_text(json.dumps(result, indent=1, allow_nan=False) + "\n")
    return result


def motion_study(
    capture: Capture, points: AnyFloats, true: Motion, progress: Progress = silent
) -> dict[str, Any]:
    """Each way to solve the motion: seconds, and its errors beside those of no motion at all."""
    peaks = sweep_peaks(capture, progress=progress)
    cloud = triangulate(capture, peaks=peaks)
    out = {
        "none": {"seconds": 0.0, **motion_errors(capture, points, Motion.none(true.steps), true)}
    }
    for method in METHODS:
        begin = time.perf_counter()
        options = MotionOptions(method=method, between="hold")
        solved = solve_motion(capture, cloud, options=options, progress=progress)
        seconds = time.perf_counter() - begin
        out[method] = {"seconds": seconds, **motion_errors(capture, points, solved, true)}
    return out


def _studies(
    capture: Capture, model: Path, options: ReconstructOptions, progress: Progress
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Error against run time of solvers and growth, and the stages' growth, in `model`'s hair."""
    progress("studies", 0.0)
    head = capture.head
    assert head is not None
    cloud = PointCloud.load(model / "points.npz")
    masks = {c.name: _mask(model, c.name) for c in capture.rig.cameras}
    stage = Stage("study")
    envelope, depths = build_envelope(
        capture, cloud, masks, head, grid=options.grid, margin=options.margin, stage=stage
    )
    measured = measure_tangents(
        capture, cloud.points, masks, depths, envelope, options.measure, stage, progress
    )
    system = field_system(envelope, measured.points, measured.directions, measured.confidence)
    solvers = compare_solvers(*system.equations())
    field, _ = solve_field(envelope, measured.points, measured.directions, measured.confidence)
    scalp = find_scalp(head, envelope)
    roots, normals = sample_roots(scalp, 2000, options.seed)
    growth = compare_growth(field, roots, normals, max_length=options.max_length)
    costs = [
        *of_triangulation(capture),
        of_field(envelope, measured),
        of_strands(field, scalp, options.max_length),
    ]
    series = {"solvers": solvers, "growth": growth}
    plot_report(
        Report([Stage(name, series=list(curves)) for name, curves in series.items()]),
        model.parent / "plots",
    )
    return (
        {name: [asdict(s) for s in curves] for name, curves in series.items()},
        [cost.to_dict() for cost in costs],
    )


def _ours(
    capture: Capture,
    truth: Truth,
    model: Path,
    options: ReconstructOptions,
    progress: Progress,
    motion: Motion | None = None,
) -> tuple[dict[str, Any], Report]:
    begin = time.perf_counter()
    report = reconstruct(capture, Model(model), options=options, motion=motion, progress=progress)
    seconds = time.perf_counter() - begin
    scores = truth.score(read_strands(model / "strands.npz"))
    return {**scores, "seconds": seconds}, report


def _baselines(capture: Capture, model: Path) -> dict[str, Strands]:
    """The baselines that use no method, in the masks that the reconstruction had."""
    masks = {c.name: _mask(model, c.name).hair for c in capture.rig.cameras}
    hull = baseline_hull(capture.rig.cameras, masks, capture.head)
    return {
        "hull_vertical": hull_vertical(hull),
        "hull_smooth_field": hull_smooth_field(hull, capture.head),
    }


def _shares(report: Report) -> dict[str, float]:
    """What Photobooth prints: bright pixels beside a maximum, points culled, field filled in."""
    points, field = report["triangulation"].figures, report["field"].figures
    return {
        "side_responses": points["side_responses"] / max(points["bright_pixels"], 1),
        "culled_by_hull": 1 - points["inside_hull"] / max(points["well_conditioned"], 1),
        "filled_in": field["unknowns"] / max(field["unknowns"] + field["measured_voxels"], 1),
    }


def _mask(model: Path, camera: str) -> HairMask:
    """A camera's mask as the reconstruction left it."""
    hair, skin = (
        np.asarray(cv2.imread(str(model / "masks" / f"{camera}_{kind}.png"), cv2.IMREAD_GRAYSCALE))
        > 127
        for kind in ("hair", "skin")
    )
    return HairMask(hair | skin, hair, skin, "user", 1.0)

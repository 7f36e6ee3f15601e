"""The light-plane method on subjects whose truth is known: quality, shares, motion, run times."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

from benchmarks.light_planes.motion_errors import motion_errors, true_motion
from benchmarks.light_planes.without_help import calibrated, copied, rig_errors
from benchmarks.pictures import picture_model, picture_motion
from benchmarks.results import save
from benchmarks.strand_truth import StrandTruth, write_hair_masks
from reconstruction import (
    Capture,
    Model,
    Progress,
    ReconstructOptions,
    Report,
    reconstruct,
    silent,
)
from reconstruction.arrays import AnyFloats
from reconstruction.light_planes import (
    Motion,
    solve_motion,
    sweep_peaks,
    triangulate,
)
from reconstruction.reconstruct_options import MotionOptions, RefineOptions

PAPER = {
    "side_responses": "75 % of bright pixels",
    "culled_by_hull": "2 % of points",
    "filled_in": "30 to 70 % of the field",
}
"""Photobooth's own shares (§3.1, §3.3)."""

METHODS: tuple[Literal["registered", "direct"], ...] = ("registered", "direct")
KINDS: tuple[Literal["hair", "skin"], ...] = ("hair", "skin")


@dataclass(frozen=True)
class SubjectCaptures:
    """One subject: its capture while still, the one while drifting, and the truth of each."""

    still: tuple[Path, Path]
    drifting: tuple[Path, Path] | None = None


def study(
    out: Path,
    case: SubjectCaptures,
    options: ReconstructOptions,
    *,
    grown: bool = False,
    without_help: bool = False,
    studies: bool = False,
    progress: Progress = silent,
) -> dict[str, Any]:
    """One subject, still and drifting, and baselines; leaves models and `OUT/result.json`.

    `grown` adds the strands as they grew, not refined.
    `without_help` adds runs without the given head and rig, and with true masks.
    `studies` adds strands with true and without motion.
    """
    capture = Capture(case.still[0])
    truth = StrandTruth(capture, case.still[1])
    still = Model(out / "still")
    runs = _Runs(truth, out, options, progress)
    report = runs.add("still", capture)
    picture_model(out / "still.png", capture, still.points(), still.strands())
    runs.scores |= truth.baselines(still)
    result: dict[str, Any] = {
        "scores": runs.scores,
        "swept": truth.swept(still.strands()),
        "shares": _shares(report),
        "stages": {s.name: {"seconds": s.seconds, "peak_gb": s.peak_gb} for s in report.stages},
    }
    save(out / "result.json", result)
    if grown:
        runs.options = replace(options, refine=RefineOptions(steps=0, marginal_coverage=0))
        runs.add("grown", capture)
        runs.options = options
        save(out / "result.json", result)
    if without_help:
        with TemporaryDirectory(dir=case.still[0].parent) as folder:  # links stay on one disk
            result["calibration"] = _without_help(runs, case, Path(folder))
        save(out / "result.json", result)
    if case.drifting is not None:
        moving = Capture(case.drifting[0])
        known = true_motion(moving, case.drifting[1])
        # the simulator moves its subject at tracking frames only
        runs.options = replace(options, motion=replace(options.motion, between="hold"))
        runs.add("drifting", moving)
        if studies:
            runs.add("true motion", moving, known)
            runs.add("no motion", moving, Motion.none(known.steps))
            models = {"no compensation": "no_motion", "compensated": "drifting", "still": "still"}
            clouds = {k: Model(out / v).points() for k, v in models.items()}
            picture_motion(out / "motion.png", clouds)
        save(out / "result.json", result)
        points = truth.strands.points[::50]
        result["motion"] = motion_study(moving, points, known, progress)
        save(out / "result.json", result)
    return result


@dataclass
class _Runs:
    """Reconstructions, one after the other, and their scores."""

    truth: StrandTruth
    out: Path
    options: ReconstructOptions
    progress: Progress
    scores: dict[str, Any] = field(default_factory=dict)

    def add(self, name: str, capture: Capture, motion: Motion | None = None) -> Report:
        """Reconstruct into a model of that name."""
        model = Model(self.out / name.replace(" ", "_"))
        begin, cpu_start = time.perf_counter(), time.process_time()
        report = reconstruct(
            capture, model, options=self.options, motion=motion, progress=self.progress
        )
        took = {
            "seconds": time.perf_counter() - begin,
            "cpu_seconds": time.process_time() - cpu_start,
        }
        self.scores[name] = {**self.truth.score(model.strands()), **took}
        save(self.out / "result.json", {"scores": self.scores})
        return report


def _without_help(runs: _Runs, case: SubjectCaptures, folder: Path) -> dict[str, float]:
    """Adds the rows; returns how far off the calibrated rig is."""
    capture, to = Capture(case.still[0]), folder / "capture"
    runs.add("laid head", copied(capture, to, head=False))
    copied(capture, to)
    write_hair_masks(Capture(to), case.still[1])
    runs.add("true masks", Capture(to))
    runs.progress("calibrating", 0.0)
    rig = calibrated(capture.rig)
    runs.add("calibrated rig", copied(capture, to, rig=rig))
    runs.add("without help", copied(capture, to, rig=rig, head=False))
    return rig_errors(rig, capture.rig)


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


def _shares(report: Report) -> dict[str, float]:
    """What Photobooth prints: bright pixels beside a maximum, points culled, field filled in."""
    points, field = report["triangulation"].figures, report["field"].figures
    return {
        "side_responses": points["side_responses"] / max(points["bright_pixels"], 1),
        "culled_by_hull": 1 - points["inside_hull"] / max(points["well_conditioned"], 1),
        "filled_in": field["unknowns"] / max(field["unknowns"] + field["measured_voxels"], 1),
    }

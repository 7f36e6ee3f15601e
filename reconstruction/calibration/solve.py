"""From captures of boards and spheres to a rig and a report of its accuracy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from reconstruction.calibration.boards import Board, CalibrationError, Sighting
from reconstruction.calibration.rig_comparison import unlike_nominal
from reconstruction.calibration.shading import refine_centres, shaded_light, with_intensity
from reconstruction.calibration.solve_cameras import CameraSolution, calibrate_cameras
from reconstruction.calibration.solve_lights import CalibratedLight, mirrored_lights
from reconstruction.calibration.solve_projectors import (
    UNDETERMINED,
    DecodedRows,
    calibrate_projector,
    projector_intensities,
    rows_on_board,
)
from reconstruction.calibration.sphere_captures import gather_shading, glints_of
from reconstruction.capture.folder import Capture
from reconstruction.geometry.cameras import Camera
from reconstruction.geometry.lights import Light
from reconstruction.geometry.projectors import Projector
from reconstruction.geometry.rig import Rig
from reconstruction.images.silhouettes import NoSilhouette, lit_image
from reconstruction.report.report import Progress, Report, Stage, silent

OFF = 1.0  # pixels: RMS of mirror sphere highlights above which a warning is given


@dataclass(frozen=True)
class TargetCaptures:
    """Captures: `boards`, one per pose, with `all_on` frames, and sweeps for projectors; `mirrors`
    and `diffuse` spheres under single lights, one per position.
    """

    boards: Sequence[Capture]
    mirrors: Sequence[Capture] = ()
    diffuse: Sequence[Capture] = ()


@dataclass(frozen=True)
class Targets:
    """Calibration targets: the board, its paper's albedo, the spheres' radii (metres) and albedo.

    The diffuse sphere's albedo scales the lights' intensities, the paper's the projectors'; with
    None the latter stay nominal. Raises `CalibrationError` for an invalid radius or albedo.
    """

    board: Board = Board()  # noqa: RUF009  frozen
    paper: float | None = None
    mirror_radius: float = 0.05
    diffuse_radius: float = 0.05
    diffuse_albedo: float = 0.8

    def __post_init__(self) -> None:
        for what in ("mirror", "diffuse"):
            radius = getattr(self, f"{what}_radius")
            if not 0 < radius < np.inf:
                raise CalibrationError(f"{what} sphere: expected a radius above 0, got {radius} m")
        for what, albedo in (("paper", self.paper), ("diffuse sphere", self.diffuse_albedo)):
            if albedo is not None and not 0 < albedo <= 1:
                raise CalibrationError(
                    f"{what}: expected an albedo above 0 and at most 1, got {albedo}"
                )


def calibrate(
    nominal: Rig,
    captures: TargetCaptures,
    targets: Targets = Targets(),
    *,
    keep_lens: bool = False,
    progress: Progress = silent,
) -> tuple[Rig, Report]:
    """Calibrate the devices of `nominal`, starting from their approximate positions there.

    Values that no capture determines stay nominal and are listed as `undetermined` in the report's
    stages. The world frame is aligned with `nominal`'s cameras. Raises `CalibrationError` if a
    camera is undetermined or its images have another size than in `nominal`.
    """
    for capture in (*captures.boards, *captures.mirrors, *captures.diffuse):
        _require_size(nominal, capture)
    report = Report()
    poses = {f"{k:02d} {c.path.name}": c for k, c in enumerate(captures.boards)}
    with report.stage("cameras") as stage:
        found = _cameras(nominal, poses, targets.board, keep_lens, stage, progress)
    projectors: tuple[Projector, ...] = nominal.projectors
    if projectors:
        with report.stage("projectors") as stage:
            projectors = _projectors(nominal, poses, found, targets, stage, progress)
    lights: tuple[Light, ...] = nominal.lights
    if lights:
        with report.stage("lights") as stage:
            lights = _lights(nominal, found.cameras, targets, captures, stage, progress)
    return Rig(nominal.name, found.cameras, lights, projectors), report


def _require_size(nominal: Rig, capture: Capture) -> None:
    sizes = {c.name: (c.width, c.height) for c in capture.rig.cameras}
    for c in nominal.cameras:
        width, height = sizes.get(c.name, (c.width, c.height))
        if (width, height) != (c.width, c.height):
            raise CalibrationError(
                f"{capture.path}: images of {c.name} have {width} × {height} pixels, expected "
                f"{c.width} × {c.height} as in the nominal rig: give the rig file with the same "
                "binning (--rig)"
            )


def sightings(captures: Mapping[str, Capture], camera: str, board: Board) -> dict[str, Sighting]:
    """Corners detected in `camera` by capture; captures without a lit frame are skipped."""
    out = {}
    for name, capture in captures.items():
        try:
            out[name] = board.find(lit_image(capture, camera))
        except NoSilhouette:
            continue
    return out


def _cameras(
    nominal: Rig,
    captures: Mapping[str, Capture],
    board: Board,
    keep_lens: bool,
    stage: Stage,
    progress: Progress,
) -> CameraSolution:
    found_corners = {}
    for k, camera in enumerate(nominal.cameras):
        progress(f"board in {camera.name}", 0.4 * k / len(nominal.cameras))
        found_corners[camera.name] = sightings(captures, camera.name, board)
    found = calibrate_cameras(nominal.cameras, board, found_corners, keep_lens=keep_lens)
    stage.figures.update(
        rms_px=found.rms,
        captures_and_corners={k: list(v) for k, v in found.observations.items()},
        focal_deviation=found.focal_deviation,
        position_deviation_mm={k: 1e3 * v for k, v in found.position_deviation.items()},
        distortion={c.name: c.distortion.tolist() for c in found.cameras},
        lens="nominal" if keep_lens else "estimated",
    )
    for name, rms in found.rms.items():
        if rms > 0.3:
            stage.warn(f"{name}: reprojection error {rms:.2g} px RMS: check that the board is flat")
    for text in unlike_nominal(found.cameras, nominal.cameras, board.square):
        stage.warn(text)
    return found


def _projectors(
    nominal: Rig,
    captures: Mapping[str, Capture],
    cameras: CameraSolution,
    targets: Targets,
    stage: Stage,
    progress: Progress,
) -> tuple[Projector, ...]:
    out: list[Projector] = []
    undetermined: dict[str, str] = {}
    figures = {}
    for k, p in enumerate(nominal.projectors):
        progress(f"sweep of {p.name}", 0.4 + 0.3 * k / len(nominal.projectors))
        parts = [
            rows_on_board(capture, camera, p.name, targets.board, cameras.board_to_world[pose])
            for pose, capture in captures.items()
            if pose in cameras.board_to_world
            and any(s.projector == p.name for s in capture.of_kind("scanline"))
            for camera in cameras.cameras
        ]
        try:
            one = calibrate_projector(p, DecodedRows.join(parts))
        except CalibrationError as error:
            undetermined[p.name] = str(error)
            out.append(p)
            continue
        undetermined[p.name] = UNDETERMINED
        out.append(one.projector)
        figures[p.name] = {
            "points": one.points,
            "rms_rows": one.rms,
            "plane_deviation_mm": 1e3 * one.plane_deviation,
            "axis_deviation_mm": 1e3 * one.axis_deviation,
            "turn_deviation_deg": float(np.degrees(one.turn_deviation)),
        }
    if targets.paper is None:
        why = "the paper's albedo was not given"
    else:
        values = projector_intensities(out, captures, cameras, targets.board, targets.paper)
        out = [replace(p, intensity=values[p.name]) if p.name in values else p for p in out]
        missing = [p.name for p in out if p.name not in values]
        why = f"{missing}: no tracking frame shows the board in their light" if missing else ""
        stage.figures["intensity"] = {k: v.tolist() for k, v in values.items()}
    if why:
        undetermined["intensity"] = f"{why}; kept as nominal"
    stage.figures.update(projectors=figures, undetermined=undetermined)
    return tuple(out)


def _lights(
    nominal: Rig,
    cameras: Sequence[Camera],
    targets: Targets,
    captures: TargetCaptures,
    stage: Stage,
    progress: Progress,
) -> tuple[Light, ...]:
    undetermined: dict[str, str] = {}
    by_name = {x.name: x for x in nominal.lights}
    names = list(by_name)
    shadings = {}
    if captures.diffuse:
        progress("diffuse sphere", 0.7)
        sphere = targets.diffuse_radius, targets.diffuse_albedo
        shadings = gather_shading(captures.diffuse, cameras, *sphere, names, stage.warn)
        shadings = refine_centres(by_name, shadings)
        stage.figures["diffuse_centres"] = next(iter(shadings.values())).centres.tolist()
    found: dict[str, CalibratedLight] = {}
    for name, shading in shadings.items():
        try:
            found[name] = shaded_light(nominal.light(name), shading)
        except CalibrationError as error:
            undetermined[name] = str(error)
    if captures.mirrors:
        progress("mirror sphere", 0.85)
        glints = glints_of(captures.mirrors, cameras, names)
        if not glints:
            raise CalibrationError(
                "mirror sphere: no highlight of a single light is visible in any camera: check "
                "for OLAT frames and that the sphere is in view"
            )
        by_mirror, centres, rms = mirrored_lights(by_name, glints, targets.mirror_radius, found)
        if rms > OFF:
            stage.warn(
                f"mirror sphere: reprojection error of highlights {rms:.2g} px RMS: check that "
                f"its radius is {1e3 * targets.mirror_radius:g} mm and that no lamp is in view"
            )
        for name, one in by_mirror.items():
            found[name] = with_intensity(one, shadings[name]) if name in found else one
        stage.figures.update(
            highlights=len(glints),
            highlights_rms_px=rms,
            saturated_highlights=sum(g.highlight.saturated for g in glints),
            mirror_centres=centres.tolist(),
        )
        for name in {g.light for g in glints} - set(found):
            undetermined[name] = (
                "its highlights determine its direction but not its distance: capture the mirror "
                "sphere in more positions, or a diffuse one"
            )
    for name in names:
        if name not in found:
            undetermined.setdefault(name, "no sphere was captured under it alone")
        elif found[name].intensity_deviation is None:
            undetermined[name] = "intensity: visible on mirror spheres only; kept as nominal"
    stage.figures.update(
        calibrated=len(found),
        position_deviation_mm={k: 1e3 * v.deviation for k, v in found.items()},
        intensity_deviation={k: v.intensity_deviation for k, v in found.items()},
        undetermined=undetermined,
    )
    return tuple(found[x.name].light if x.name in found else x for x in nominal.lights)

"""From captures of boards and spheres to a rig, with a report of what is known how well."""

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

OFF = 1.0  # pixels: highlights of a mirror sphere alone are met better, root mean square


@dataclass(frozen=True)
class TargetCaptures:
    """What was shot: `boards`, one a pose, with `all_on` frames, and sweeps where they calibrate
    projectors; `mirrors` and `diffuse` spheres under single lights, one a place.
    """

    boards: Sequence[Capture]
    mirrors: Sequence[Capture] = ()
    diffuse: Sequence[Capture] = ()


@dataclass(frozen=True)
class Targets:
    """What stood on the stage: the board, its paper's albedo, the spheres' radii and albedo.

    Metres. The diffuse sphere's albedo scales all lights' intensities, the paper's all projectors';
    None leaves the projectors' intensities nominal. Raises `CalibrationError` for a radius that is
    no length, or an albedo out of (0, 1].
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
                raise CalibrationError(f"{what} sphere: its radius is no length, {radius} m")
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
    """Calibrate the rig whose devices are called as in `nominal`, and are about there.

    Pictures are taken less their dark frames. What no capture determines stays nominal and stands
    in the report's stages under `undetermined`.

    The world is `nominal`'s: the rigid motion that fits its cameras best. Raises
    `CalibrationError` where cameras stay open, or took pictures of another size than `nominal` has.
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
                f"{capture.path}: pictures of {c.name} have {width} × {height} pixels, in the "
                f"nominal rig they have {c.width} × {c.height}: give the rig file of the stage as "
                "it was shot, binning and all (--rig)"
            )


def sightings(captures: Mapping[str, Capture], camera: str, board: Board) -> dict[str, Sighting]:
    """Where `camera` sees the corners, by capture; captures without a lit frame are left out."""
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
    seen = {}
    for k, camera in enumerate(nominal.cameras):
        progress(f"board in {camera.name}", 0.4 * k / len(nominal.cameras))
        seen[camera.name] = sightings(captures, camera.name, board)
    found = calibrate_cameras(nominal.cameras, board, seen, keep_lens=keep_lens)
    stage.figures.update(
        rms_px=found.rms,
        captures_and_corners={k: list(v) for k, v in found.seen.items()},
        focal_deviation=found.focal_deviation,
        position_deviation_mm={k: 1e3 * v for k, v in found.position_deviation.items()},
        distortion={c.name: c.distortion.tolist() for c in found.cameras},
        lens="nominal" if keep_lens else "estimated",
    )
    for name, rms in found.rms.items():
        if rms > 0.3:
            stage.warn(f"{name}: corners are off by {rms:.2g} px (rms): is the board flat?")
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
        why = "without the paper's albedo"
    else:
        values = projector_intensities(out, captures, cameras, targets.board, targets.paper)
        out = [replace(p, intensity=values[p.name]) if p.name in values else p for p in out]
        missing = [p.name for p in out if p.name not in values]
        why = f"of {missing}: no tracking frame shows the board in their light" if missing else ""
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
                "mirror sphere: no camera sees a highlight of any single light: are there OLAT "
                "frames, and is the sphere in view?"
            )
        by_mirror, centres, rms = mirrored_lights(by_name, glints, targets.mirror_radius, found)
        if rms > OFF:
            stage.warn(
                f"mirror sphere: highlights are off by {rms:.2g} px (rms): is its radius "
                f"{1e3 * targets.mirror_radius:g} mm, and does nothing else shine, as a light that "
                "a camera sees?"
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
                "its highlights tell its direction but not its distance: shoot the mirror sphere "
                "in more places, or a diffuse one"
            )
    for name in names:
        if name not in found:
            undetermined.setdefault(name, "no sphere was shot under it alone")
        elif found[name].intensity_deviation is None:
            undetermined[name] = "intensity: only mirrors showed it; kept as nominal"
    stage.figures.update(
        calibrated=len(found),
        position_deviation_mm={k: 1e3 * v.deviation for k, v in found.items()},
        intensity_deviation={k: v.intensity_deviation for k, v in found.items()},
        undetermined=undetermined,
    )
    return tuple(found[x.name].light if x.name in found else x for x in nominal.lights)

"""Captures without the subject's motion between their frames.

As Photobooth (Paris et al. 2008, §3.1) does for stripes, fully lit frames among the single lights
give rigid motions, interpolated in between. Every frame is resampled to the pose of the first lit
frame, by the depth of the visual hull; a single light moves to where the subject had it when it
shone. The view of a moved subject remains that of its own pose: a turn by 1° changes highlights.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation

from reconstruction.arrays import Array, Bools
from reconstruction.capture.derived import copy_frame, derived
from reconstruction.capture.folder import Capture
from reconstruction.capture.records import CaptureError, Step
from reconstruction.capture.writer import CaptureWriter
from reconstruction.files.exr import read_exr
from reconstruction.geometry.lens import any_resampled, resampled
from reconstruction.geometry.voxels import VoxelGrid
from reconstruction.images.grey import grey
from reconstruction.images.silhouettes import NoSilhouette, silhouette
from reconstruction.images.visual_hull import first_depth, surface_points, visual_hull
from reconstruction.light_planes.motion import Motion
from reconstruction.light_planes.registration import Template, smooth
from reconstruction.light_planes.rigid_fit import Pose
from reconstruction.light_planes.tracking import (
    likeness,
    present_views,
    solve_motion,
    tracked_views,
)
from reconstruction.light_planes.warp import Warp
from reconstruction.report.report import Progress, Stage, silent

VOXEL = 3e-3  # metres; a millimetre of depth is 17 micrometres across at a turn by 1°
WIDEST = 1300  # pixels of the reduced images that are registered, as Photobooth's
LEAST_LIT, MOST_CLIPPED = 0.5, 0.3  # of the median brightness; of the lit pixels
LOCAL, BLUR = 2.0, 0.7  # pixels
OUTLINE = 0.07  # of the root of a mask's area
BLOCK = 0.02  # metres of a chequerboard in space
JUMP = 4.0  # times the median motion between lit frames
POINTS = 2000  # of a camera by which motions are measured


@dataclass(frozen=True, eq=False)
class Stabilised:
    """The `capture` to use: the new one, or the source if nothing was corrected; `summary` says
    which and why in one sentence. `figures` are JSON-ready."""

    capture: Capture
    motion: Motion
    summary: str
    figures: dict[str, Any]
    warnings: tuple[str, ...] = ()


def stabilise(source: Capture, out: Path, progress: Progress = silent) -> Stabilised:
    """Write the capture `out`, a new or empty folder, of `source` without the subject's motion.

    Nothing is written without two usable lit frames at different times, if no camera shows motion,
    if it is less than twice the estimated error, or if the lit frames do not come closer to the
    first one by it. Frames whose pose is unknown are recorded as missing. Raises `CaptureError` for
    a stabilised capture, and for one without a visual hull.
    """
    if "stabilised" in source.plan:
        raise CaptureError(f"{source.path}: its motion has been corrected already")
    stage = Stage("motion")
    steps = usable_lit_frames(source, stage)
    unchanged = f"{source.path} remains as it is: "
    if len(steps) < 2:
        why = (
            f"{len(steps)} usable fully lit frames among its single lights; motion needs 2 or more"
        )
        return Stabilised(source, Motion.none(), unchanged + why, {}, tuple(stage.warnings))
    solver = _Solver.of(source, steps)
    motion = solver.solve(stage, progress)
    shown = stage.figures.get("largest_2d_motion_px")
    if shown is None or motion.still:
        why = "no camera's lit frames can be registered: its motion is unknown"
        if shown is not None:
            most = shown * solver.view.reduced_by
            why = f"{len(steps)} lit frames show no motion: at most {most:.2g} px"
        return Stabilised(source, motion, unchanged + why, {}, tuple(stage.warnings))
    figures = solver.figures(motion)
    if figures["largest_mm"] < 2 * figures["error_mm"]:
        why = (
            f"the subject kept still within the estimated error of {figures['error_mm']:.2g} mm "
            f"({figures['error_px']:.2g} px) in {len(steps)} lit frames"
        )
        return Stabilised(source, motion, unchanged + why, figures, tuple(stage.warnings))
    before, after = solver.differences(motion)
    figures |= {"lit_difference_as_shot": before, "lit_difference_stabilised": after}
    differ = f"lit frames differ from the first by {before:.1%} as shot, {after:.1%} stabilised"
    if after >= before:
        return Stabilised(source, motion, unchanged + differ, figures, tuple(stage.warnings))
    motion, jumps = solver.with_jumps(motion, figures["error_mm"] / 1e3, stage)
    figures["jumps"] = jumps
    motion = _referred(source, motion)
    _write(source, out, solver, motion, figures, progress)
    summary = (
        f"{out}: {len(steps)} lit frames show motion of up to {figures['largest_mm']:.2g} mm "
        f"({figures['largest_px']:.2g} px) and {figures['largest_deg']:.2g}°; estimated error "
        f"{figures['error_mm']:.2g} mm ({figures['error_px']:.2g} px)"
    )
    if "left_out_mm" in figures:
        summary += f"; a lit frame that is left out, {figures['left_out_mm']:.2g} mm"
    summary += f"; {differ}"
    return Stabilised(Capture(out), motion, summary, figures, tuple(stage.warnings))


def lit_frames(capture: Capture) -> list[Step]:
    """The fully lit frames, of the kind that divides the single lights or patterns most often."""

    def times(steps: Sequence[Step]) -> int:
        singles = [s.index for s in capture.steps if s.lighting is not None]
        return len(set(np.searchsorted(singles, [s.index for s in steps]).tolist()))

    kinds = [capture.of_kind("all_on"), capture.of_kind("tracking")]
    if capture.of_kind("scanline"):  # its tracking frames have other light
        kinds.pop()
    steps = max(kinds, key=times)
    return list(steps) if times(steps) > 1 else list(steps[:1])


def usable_lit_frames(capture: Capture, stage: Stage) -> list[Step]:
    """`lit_frames` without dark and saturated ones, which `stage` warns of."""
    steps = lit_frames(capture)
    if len(steps) < 2:
        return steps
    names = [c.name for c in capture.rig.cameras]
    few = names[:: max(1, len(names) // 4)][:4]
    level = np.full((len(steps), len(few)), np.nan)
    clipped = np.zeros(level.shape)
    for i, step in enumerate(steps):
        for k, name in enumerate(few):
            if capture.has(step, name):
                image, saturated = capture.response_and_saturated(step, name)
                level[i, k] = np.maximum(image, 0).mean()
                lit = grey(image) > 0.1 * float(image.max(initial=0.0))
                clipped[i, k] = saturated.sum() / max(int(lit.sum()), 1)
    there = np.isfinite(level)
    relative = level / np.maximum(np.nanmedian(level, axis=0), np.finfo(float).tiny)
    dark = (np.where(there, relative, 0).max(axis=1) < LEAST_LIT) & there.any(axis=1)
    blown = np.where(there, clipped, 0).mean(axis=1) > MOST_CLIPPED
    for what, which in (("dark", dark), ("saturated", blown & ~dark)):
        if which.any():
            numbers = ", ".join(str(steps[i].index) for i in np.flatnonzero(which)[:5])
            stage.warn(f"{int(which.sum())} lit frames are {what} and not used: steps {numbers}")
    return [s for s, bad in zip(steps, dark | blown, strict=True) if not bad]


@dataclass(frozen=True, eq=False)
class _Solver:
    """Reduced images of a capture, its hull, and points `(N, 3)` on it by camera."""

    view: Capture
    steps: list[Step]
    hull: VoxelGrid
    points: Mapping[str, Array]

    @classmethod
    def of(cls, source: Capture, steps: list[Step]) -> _Solver:
        widest = max(max(c.width, c.height) for c in source.rig.cameras)
        view = source.view(undistorted=True, reduced=max(1, round(widest / WIDEST)))
        masks: dict[str, Bools] = {}
        for camera in view.rig.cameras:
            try:
                mask = silhouette(view, camera.name)
            except NoSilhouette:
                continue
            if mask.any():
                masks[camera.name] = mask
        try:
            hull = visual_hull(view.rig.cameras, masks, spacing=VOXEL)
        except ValueError as error:
            raise CaptureError(f"{source.path}: no volume to track: {error}") from error
        points = {}
        for camera in view.rig.cameras:
            if camera.name in masks:
                hair = view.mask(camera.name)  # which may move apart from the body
                on = masks[camera.name] if hair is None else hair
                # an outline stays where it is when a round subject turns
                margin = round(OUTLINE * float(np.sqrt(on.sum()))) + 1
                depth = first_depth(camera, hull)
                on = ndimage.binary_erosion(on, iterations=margin) & np.isfinite(depth)
                points[camera.name] = surface_points(camera, depth)[on]
        return cls(view, steps, hull, points)

    def solve(self, stage: Stage, progress: Progress) -> Motion:
        """The motion by all cameras."""
        return solve_motion(self.view, self.points, lit=self.steps, progress=progress, stage=stage)

    def figures(self, motion: Motion) -> dict[str, Any]:
        """The largest motion; its error from the motions by each half of the cameras, or, of few,
        of the surface; and the error of interpolation from lit frames between others."""
        if len(self.points) > 5:
            names = sorted(self.points)
            halves = [{n: self.points[n] for n in names[k::2]} for k in (0, 1)]
        else:
            block = {n: np.floor(p / BLOCK).sum(axis=1) % 2 for n, p in self.points.items()}
            halves = [{n: p[block[n] == k] for n, p in self.points.items()} for k in (0, 1)]
        # the mean of two independent motions is off by half of their difference
        one, other = (
            solve_motion(self.view, half, lit=self.steps).at(motion.steps) for half in halves
        )
        error = self.apart(one, other) / 2
        poses = motion.at(motion.steps)
        moved = self.apart(poses, Motion.none().at(motion.steps))
        turns = np.linalg.norm(Rotation.from_matrix(poses[0]).as_rotvec(), axis=1)
        out = {
            "lit_frames": len(self.steps),
            "lost_frames": len(motion.lost),
            "largest_mm": 1e3 * float(moved[:, 0].max(initial=0.0)),
            "largest_px": float(moved[:, 1].max(initial=0.0)) * self.view.reduced_by,
            "largest_deg": float(np.degrees(turns.max(initial=0.0))),
            "error_mm": 1e3 * float(np.sqrt((error[1:, 0] ** 2).mean())),
            "error_px": float(np.sqrt((error[1:, 1] ** 2).mean())) * self.view.reduced_by,
        }
        if len(motion.steps) > 2 and not motion.still:
            left_out = [
                self.apart(
                    replace(
                        motion,
                        steps=np.delete(motion.steps, k),
                        rotations=np.delete(motion.rotations, k, axis=0),
                        translations=np.delete(motion.translations, k, axis=0),
                    ).at(motion.steps[k]),
                    (poses[0][k : k + 1], poses[1][k : k + 1]),
                )[0, 0]
                for k in range(1, len(motion.steps) - 1)
            ]
            out["left_out_mm"] = 1e3 * float(np.sqrt(np.mean(np.square(left_out))))
        return out

    def differences(self, motion: Motion) -> tuple[float, float]:
        """Relative difference, root mean square, of lit frames from the first one in reduced images
        of the hull, as shot and stabilised; blurred by `BLUR`, as resampling blurs noise."""
        first, *others = [s for s in self.steps if motion.known([s.index])[0]]
        off, size = np.zeros(2), 0.0
        for camera in self.view.rig.cameras:
            if camera.name not in self.points or not self.view.has(first, camera.name):
                continue
            warp = Warp.of(camera, self.hull, 1)
            on = np.isfinite(first_depth(camera, self.hull))
            still = smooth(grey(self.view.frame(first, camera.name)), BLUR)[on]
            for step in (s for s in others if self.view.has(s, camera.name)):
                (turn,), (shift,) = motion.at(step.index)
                image = self.view.frame(step, camera.name)
                both = image, resampled(image, warp.maps(turn, shift))
                off += [np.square(smooth(grey(x), BLUR)[on] - still).sum() for x in both]
                size += float(np.square(still).sum())
        before, after = np.sqrt(off / max(size, np.finfo(float).tiny))
        return float(before), float(after)

    def apart(self, a: Pose, b: Pose) -> Array:
        """How far poses `(T, 3, 3), (T, 3)` put the points apart: root mean squares `(T, 2)`,
        metres, and pixels of the worst camera."""
        out = np.zeros((len(a[0]), 2))
        for k, (ra, ta, rb, tb) in enumerate(zip(*a, *b, strict=True)):
            metres, pixels = [], [0.0]
            for camera in self.view.rig.cameras:
                own = self.points.get(camera.name, np.zeros((0, 3)))
                own = own[:: max(1, len(own) // POINTS)]
                if len(own):
                    one, other = own @ ra.T + ta, own @ rb.T + tb
                    metres.append(((one - other) ** 2).sum(axis=1).mean())
                    shift = camera.project(one)[0] - camera.project(other)[0]
                    pixels.append(float(np.sqrt((shift**2).sum(axis=1).mean())))
            out[k] = np.sqrt(np.mean(metres)), max(pixels)
        return out

    def with_jumps(self, motion: Motion, error: float, stage: Stage) -> tuple[Motion, int]:
        """The motion with jumps, and their number.

        If the subject moves by over `JUMP` times the usual way from a lit frame to the next, the
        time is that at which the single lights between change from one pose's image to the other's.
        """
        poses = list(zip(motion.rotations, motion.translations, strict=True))
        moved = self.apart(
            (motion.rotations[1:], motion.translations[1:]),
            (motion.rotations[:-1], motion.translations[:-1]),
        )[:, 0]
        views = [
            replace(v, template=Template(texture(v.template.raw), v.template.mask))
            for v in tracked_views(self.view, self.steps[0], self.points, Stage(""))
        ]
        knots, found = [motion.steps[0]], [poses[0]]
        count = 0
        for k, way in enumerate(moved):
            usual = max(float(np.median(np.delete(moved, k))) if len(moved) > 2 else np.inf, error)
            a, b = (int(s) for s in motion.steps[k : k + 2])
            singles = [s for s in self.view.steps if a < s.index < b and s.lighting is not None]
            if way > JUMP * usual and singles:
                like = []
                for s in singles:
                    present, images = present_views(self.view, s, views)
                    images = {name: texture(image) for name, image in images.items()}
                    like.append(
                        [
                            np.mean([likeness([v], images, p) for v in present] or [0.0])
                            for p in poses[k : k + 2]
                        ]
                    )
                # the best number of singles before the jump
                gain = np.concatenate([[0.0], np.cumsum(-np.diff(like, axis=1))])
                at = int(np.argmax(gain))
                count += 1
                stage.warn(
                    f"the subject jumped by {1e3 * way:.2g} mm between the lit frames of steps {a} "
                    f"and {b}: before step {singles[at].index if at < len(singles) else b}, by the "
                    "single lights between them"
                )
                if at:
                    knots, found = [*knots, singles[at - 1].index], [*found, poses[k]]
                if at < len(singles):
                    knots, found = [*knots, singles[at].index], [*found, poses[k + 1]]
            knots, found = [*knots, b], [*found, poses[k + 1]]
        rotations, translations = (np.stack(x) for x in zip(*found, strict=True))
        new = replace(motion, steps=np.array(knots), rotations=rotations, translations=translations)
        return new, count


def texture(image: Array) -> Array:
    """`image (H, W)` over its local mean: much of what a light changes is gone."""
    mean = smooth(image, LOCAL)
    return np.asarray(image / np.maximum(mean + 0.1 * float(mean.max(initial=0.0)), 1e-12))


def _referred(source: Capture, motion: Motion) -> Motion:
    """The motion from the pose at the first tracking frame of a sweep, which has its own motion."""
    if not source.of_kind("scanline") or not source.of_kind("tracking"):
        return motion
    (turn,), (shift,) = motion.at(source.of_kind("tracking")[0].index)
    rotations = motion.rotations @ turn.T
    return replace(
        motion, rotations=rotations, translations=motion.translations - rotations @ shift
    )


def _write(
    source: Capture,
    out: Path,
    solver: _Solver,
    motion: Motion,
    figures: dict[str, Any],
    progress: Progress,
) -> None:
    times: dict[str, list[int]] = {}
    for s in source.of_kind("olat"):
        times.setdefault(str(s.light), []).append(s.index)
    lights = []
    for light in source.rig.lights:
        if light.name in times:
            (turn,), (shift,) = motion.at(np.mean(times[light.name]))
            light = light.moved(turn, shift)
        lights.append(light)
    plan = {**source.plan, "stabilised": {**figures, "motion": motion.to_dict()}}
    swept = bool(source.of_kind("scanline"))
    as_they_are = {"dark", "scanline", *(["tracking"] if swept else [])}
    rig = replace(source.rig, lights=tuple(lights))
    with derived(source, out, rig, plan, "stabilised_from") as writer:
        for k, camera in enumerate(source.rig.cameras):
            progress("stabilising", k / len(source.rig.cameras))
            warp = Warp.of(camera, solver.hull, solver.view.reduced_by)
            for step in source.steps:
                if step.kind in as_they_are or not source.has(step, camera.name):
                    copy_frame(source, step, camera.name, writer)
                elif not motion.known([step.index])[0]:
                    why = (
                        "the subject's pose is unknown: a lit frame beside it could not be aligned"
                    )
                    writer.record_missing(step, camera.name, reason=why)
                else:
                    _write_warped(source, step, camera.name, warp, motion, writer)


def _write_warped(
    source: Capture, step: Step, camera: str, warp: Warp, motion: Motion, writer: CaptureWriter
) -> None:
    image, attributes = source.read_file(step, camera, read_exr)
    full = float(attributes.get("fullScale", np.inf))
    saturated = np.asarray((image >= np.float32(full * (1 - 1e-5))).any(axis=-1))
    (turn,), (shift,) = motion.at(step.index)
    maps = warp.maps(turn, shift)
    out = np.minimum(resampled(image, maps), full * (1 - 1e-4)).astype(np.float32)
    out[any_resampled(saturated, maps)] = full if saturated.any() else 0.0
    writer.write_frame(step, camera, out, full_scale=full)

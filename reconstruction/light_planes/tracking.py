"""The motion solve: one rigid motion for each tracking frame, from all cameras.

"registered" is Photobooth's: a 2D rigid registration per camera (Eq. 1), then the 3D motion that
explains them (Eq. 2), with the 2D rotation as a third equation. "direct" aligns the images of all
cameras at once by warping the triangulated points, from the registered motion or that of the
tracking frame before, whichever correlates better.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation

from reconstruction.arrays import Array
from reconstruction.capture.folder import Capture
from reconstruction.capture.records import Step
from reconstruction.geometry.cameras import Camera
from reconstruction.images.silhouettes import dark_frame
from reconstruction.light_planes.motion import Motion
from reconstruction.light_planes.point_cloud import PointCloud
from reconstruction.light_planes.registration import (
    Registration,
    Template,
    gradients,
    sample,
    smooth,
    spline,
)
from reconstruction.light_planes.rigid_fit import Determination, Pose, flow, gauss_newton, numeric
from reconstruction.reconstruct_options import MotionOptions
from reconstruction.report.report import Progress, Stage, silent

SIGMA = 1.5  # pixels of the Gaussian before images are compared
ALIKE = 0.6  # correlation below which a tracking frame is lost


STILL_PX = 0.03  # smaller motions, or those within the noise of all cameras together, are none
MOST_POINTS = 12000  # points of a camera

STILL: Pose = (np.eye(3), np.zeros(3))


@dataclass(frozen=True, eq=False)
class TrackedView:
    """One camera's reference image, prepared, and its points."""

    camera: Camera
    template: Template
    points: Array
    pixels: Array

    @cached_property
    def reference(self) -> Array:
        """The smoothed reference image at the points' pixels `(N,)`."""
        return sample(spline(smooth(self.template.raw, SIGMA)), *self.pixels.T)

    @cached_property
    def offsets(self) -> Array:
        """The points' pixels from their mean `(N, 2)`."""
        return self.pixels - self.pixels.mean(axis=0)

    @cached_property
    def spread(self) -> float:
        """The rms distance of the points' pixels from their mean."""
        return float(np.sqrt((self.offsets**2).sum(axis=1).mean()))


def solve_motion(
    capture: Capture,
    points: PointCloud | Mapping[str, Array],
    *,
    lit: Sequence[Step] | None = None,
    options: MotionOptions | None = None,
    progress: Progress = silent,
    stage: Stage | None = None,
) -> Motion:
    """Rigid motion from the first tracking frame (the reference pose) to each of the others.

    `points` is a cloud without motion compensation, or `(N, 3)` by camera; `lit` are steps to use
    instead of the tracking frames. A capture without tracking frames, or a subject
    that kept still, gives `Motion.still`. Directions of motion that the cameras do not determine
    stay zero, with a warning in `stage`. Frames below `ALIKE` are `Motion.lost`, with a warning.
    """
    options, stage = options or MotionOptions(), stage or Stage("motion")
    if isinstance(points, PointCloud):
        points = {name: points.of_camera(name).points for name in points.cameras}
    lit = capture.of_kind("tracking") if lit is None else lit
    steps = [s for s in lit if any(capture.has(s, c) for c in points)]
    if len(steps) < 2:
        stage.leave_out("motion solve", f"{len(steps)} tracking frames", "the whole stage")
        return Motion.none([s.index for s in steps])
    views = tracked_views(capture, steps[0], points, stage)
    if not views:
        stage.warn("no camera could be registered: the subject is assumed to be still")
        return Motion.none([s.index for s in steps])
    largest, moved = 0.0, False
    for step in steps[1:]:
        present, images = present_views(capture, step, views)
        quick = [v.template.register(images[v.camera.name], iterations=1) for v in present]
        largest = max([largest, *(r.largest() for r in quick)])
        moved |= _moved(quick)
        # large motions leave registration residuals that pass for noise
        moved |= bool(present) and likeness(present, images, STILL) < ALIKE
    stage.figures["largest_2d_motion_px"] = largest
    if not moved:
        stage.leave_out(
            "motion solve",
            f"nothing moved: at most {largest:.3f} px in {len(steps)} tracking frames",
            f"{len(steps) - 1} rigid alignments of {len(views)} cameras",
        )
        return Motion.none([s.index for s in steps])
    return _solve_all(capture, steps, views, options, progress, stage)


def _solve_all(
    capture: Capture,
    steps: list[Step],
    views: list[TrackedView],
    options: MotionOptions,
    progress: Progress,
    stage: Stage,
) -> Motion:
    poses, residuals, found_of, pairs = [STILL], [], [], 0
    kept, lost = [steps[0].index], []
    for i, step in enumerate(steps[1:]):
        progress("motion", i / (len(steps) - 1))
        present, images = present_views(capture, step, views)
        if not present:
            continue
        found = [(v, v.template.register(images[v.camera.name], iterations=15)) for v in present]
        pairs += len(found)
        pose, determined, residual = from_registrations(found)
        if options.method == "direct":
            starts = (pose, poses[-1])  # registration fails on large motions
            start = max(starts, key=lambda p: likeness(present, images, p))
            pose, determined = align(present, images, start)
        if likeness(present, images, pose) < ALIKE:
            lost.append(step.index)
            continue
        kept.append(step.index)
        poses.append(pose)
        found_of.append(determined)
        residuals.append(residual)
    if lost:
        stage.warn(
            f"{len(lost)} of {len(steps)} tracking frames (the first is step {lost[0]}) could not "
            "be aligned: the subject moved too far or was hidden. The frames between them and "
            "their neighbours are ignored"
        )
        stage.figures["lost_frames"] = len(lost)
    if not found_of:
        return replace(Motion.none(kept), lost=np.array(lost), still=False)
    least = min(found_of, key=lambda d: (d.rank, d.strength[0]))
    rank = least.rank
    if rank < 6:
        stage.warn(
            f"{len(views)} cameras determine {rank} of 6 directions of motion; the other "
            f"{6 - rank} are assumed zero: {'; '.join(least.missing)}. Add cameras around the "
            "subject to determine them"
        )
    distance = [float(np.linalg.norm(t)) for _, t in poses]
    turn = [float(np.linalg.norm(Rotation.from_matrix(R).as_rotvec())) for R, _ in poses]
    stage.figures |= {
        "method": options.method,
        "tracking_frames": len(steps),
        "registrations": pairs,
        "largest_translation_mm": max(distance) * 1e3,
        "largest_rotation_deg": float(np.degrees(max(turn))),
        "registration_residual_px": float(np.median(residuals)),
        "determined_directions": rank,
        "weakest_direction": least.named(1)[0],
        "weakest_strength": float(least.strength[0]),
    }
    progress("motion", 1.0)
    return Motion(
        np.array(kept),
        np.stack([R for R, _ in poses]),
        np.stack([t for _, t in poses]),
        between=options.between,
        determined=rank,
        lost=np.array(lost, np.int64),
    )


def from_registrations(
    found: list[tuple[TrackedView, Registration]],
) -> tuple[Pose, Determination, float]:
    """The motion that best explains 2D registrations (Photobooth Eq. 2), robustly.

    Three equations a camera: the mean shift of its points in its image, and their turn at the
    points' rms distance. Returns the pose, its determination, and the rms residual in pixels.
    """
    target = np.concatenate(
        [[*_rigid_at(r, v.pixels.mean(axis=0)), r.angle * v.spread] for v, r in found]
    )

    def residual(pose: Pose) -> Array:
        shifts = []
        for view, _ in found:
            moved, _ = view.camera.project(view.points @ pose[0].T + pose[1])
            x, y = view.offsets.T
            angle = np.arctan2(x @ moved[:, 1] - y @ moved[:, 0], x @ moved[:, 0] + y @ moved[:, 1])
            shift = (moved - view.pixels).mean(axis=0)
            shifts.append([*shift, angle * view.spread])
        return np.concatenate(shifts) - target

    pose, determined = gauss_newton(lambda p: (residual(p), numeric(residual, p)), 12)
    return pose, determined, float(np.sqrt(np.mean(residual(pose) ** 2)))


def align(
    views: list[TrackedView], images: dict[str, Array], start: Pose
) -> tuple[Pose, Determination]:
    """The motion under which every camera's image `(H, W)` at the moved points equals its
    reference, and its determination."""
    prepared = []
    for view in views:
        picture = smooth(images[view.camera.name], SIGMA)
        gx, gy = gradients(picture)
        prepared.append((view, spline(picture), spline(gx), spline(gy)))

    def system(pose: Pose) -> tuple[Array, Array]:
        errors, rows = [], []
        for view, picture, gx, gy in prepared:
            moved, value = view.points @ pose[0].T + pose[1], view.reference
            pixels, depth = view.camera.project(moved)
            u, v = pixels.T
            now = sample(picture, u, v)
            gain = float(now @ value) / max(float(value @ value), np.finfo(float).tiny)
            scale = 1.0 / max(float(np.sqrt(np.mean(value**2))), np.finfo(float).tiny)
            gradient = np.stack([sample(gx, u, v), sample(gy, u, v)], axis=1) * scale
            inside = view.camera.inside(pixels) & (depth > 0)
            errors.append((now - gain * value) * scale * inside)
            rows.append(flow(gradient, view.camera, moved, depth) * inside[:, None])
        return np.concatenate(errors), np.concatenate(rows)

    return gauss_newton(system, 10, start)


def likeness(views: list[TrackedView], images: dict[str, Array], pose: Pose) -> float:
    """Correlation of `images (H, W)` at the moved points with the reference, median over cameras.

    Times the share of the points inside the image.
    """
    out = []
    for view in views:
        pixels, depth = view.camera.project(view.points @ pose[0].T + pose[1])
        inside = view.camera.inside(pixels) & (depth > 0)
        if inside.sum() < 10:
            out.append(0.0)
            continue
        places = pixels[inside].T[::-1]
        picture = smooth(images[view.camera.name], SIGMA)
        now = ndimage.map_coordinates(picture, places, order=1, mode="nearest")
        value = view.reference[inside]
        now, value = now - now.mean(), value - value.mean()
        size = float(np.sqrt((now @ now) * (value @ value)))
        out.append(float(now @ value) / max(size, np.finfo(float).tiny) * float(inside.mean()))
    return float(np.median(out))


def tracked_views(
    capture: Capture, reference: Step, points: Mapping[str, Array], stage: Stage
) -> list[TrackedView]:
    """The cameras that can be registered, by `points (N, 3)` of each; warns of the others."""
    rng = np.random.default_rng(0)
    views = []
    for camera in capture.rig.cameras:
        if not capture.has(reference, camera.name):
            stage.warn(f"{camera.name} has no reference tracking frame and is not used")
            continue
        own = points.get(camera.name, np.zeros((0, 3)))
        pixels, depth = camera.project(own)
        own = own[(depth > 0) & camera.inside(pixels)]
        if len(own) < 30:
            stage.warn(f"{camera.name} has {len(own)} points: not used for motion")
            continue
        if len(own) > MOST_POINTS:
            own = own[np.sort(rng.choice(len(own), MOST_POINTS, replace=False))]
        pixels = camera.project(own)[0]
        image = tracking_image(capture, reference, camera.name)
        mask = np.zeros(image.shape, bool)
        mask[tuple(np.rint(pixels[:, ::-1]).astype(int).T)] = True
        # includes the contour against the dark background, the strongest feature
        mask = ndimage.binary_dilation(mask, iterations=3)
        clipped = capture.saturated(reference, camera.name)
        try:
            template = Template(image, mask & ~clipped)
        except ValueError as error:
            stage.warn(f"{camera.name} is not used for motion: {error}")
            continue
        views.append(TrackedView(camera, template, own, pixels))
    return views


def tracking_image(capture: Capture, step: Step, camera: str) -> Array:
    """The square root of the radiance: photon noise is then uniform."""
    dark = dark_frame(capture, camera, step.exposure)
    image = capture.frame(step, camera).mean(axis=-1) - dark
    return np.asarray(np.sqrt(np.maximum(image, 0) / (step.level or 1.0)), np.float64)


def present_views(
    capture: Capture, step: Step, views: list[TrackedView]
) -> tuple[list[TrackedView], dict[str, Array]]:
    """The views that have a frame of this step, and the images."""
    present = [v for v in views if capture.has(step, v.camera.name)]
    return present, {v.camera.name: tracking_image(capture, step, v.camera.name) for v in present}


def _moved(frame: list[Registration]) -> bool:
    """Whether the cameras' registrations of one frame are significant: χ² per degree of freedom
    more than four deviations above 1."""
    if max((r.largest() for r in frame), default=0.0) <= STILL_PX:
        return False
    tiny = np.finfo(float).tiny
    squares = np.concatenate(
        [np.array([*r.shift, r.angle]) ** 2 / np.maximum(r.deviation**2, tiny) for r in frame]
    )
    return float(squares.mean()) > 1 + 4 * np.sqrt(2 / len(squares))


def _rigid_at(registration: Registration, pixel: Array) -> Array:
    """The shift `(2,)` by a registration at `pixel (2,)`."""
    c, s = np.cos(registration.angle), np.sin(registration.angle)
    offset = pixel - registration.centre
    turned = np.array([c * offset[0] - s * offset[1], s * offset[0] + c * offset[1]])
    return np.asarray(turned - offset + registration.shift)

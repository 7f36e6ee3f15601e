"""Registration and the rigid motion solve, against motions that are known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from reconstruction import Camera, Capture, Projector, Stage
from reconstruction.light_planes import Motion, solve_motion, triangulate
from reconstruction.light_planes.registration import Template, gradients, sample, spline
from reconstruction.light_planes.tracking import STILL, TrackedView, likeness
from reconstruction.reconstruct_options import MotionOptions

CORNERS = np.array(np.meshgrid([-0.07, 0.07], [-0.07, 0.07], [-0.07, 0.07])).reshape(3, -1).T


def waves(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A smooth picture without a period inside 64 pixels."""
    return 1 + 0.4 * np.sin(0.31 * x + 0.12 * y) + 0.3 * np.cos(0.23 * y - 0.08 * x + 0.004 * x * y)


@pytest.mark.parametrize(
    ("shift", "angle"),
    [((0.0, 0.0), 0.0), ((0.7, -0.4), 0.0), ((-1.6, 2.3), 0.02), ((0, 0), -0.03)],
)
def test_rigid_registration_is_exact_to_a_fiftieth_of_a_pixel(
    shift: tuple[float, float], angle: float
) -> None:
    x, y = np.meshgrid(np.arange(64.0), np.arange(64.0))
    mask = np.zeros((64, 64), bool)
    mask[12:50, 14:52] = True
    template = Template(waves(x, y), mask)
    c, s = np.cos(angle), np.sin(angle)
    dx, dy = x - template.centre[0] - shift[0], y - template.centre[1] - shift[1]
    back = template.centre[0] + c * dx + s * dy, template.centre[1] - s * dx + c * dy
    found = template.register(1.1 * waves(*back))  # the gain is solved for as well
    assert found.converged
    assert found.shift == pytest.approx(np.array(shift, float), abs=0.02)
    assert found.angle * found.lever == pytest.approx(angle * found.lever, abs=0.02)


def test_registration_states_its_noise() -> None:
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.arange(64.0), np.arange(64.0))
    mask = np.ones((64, 64), bool)
    template = Template(waves(x, y), mask)
    found = [template.register(waves(x, y) + rng.normal(0, 0.1, x.shape)) for _ in range(20)]
    spread = np.std([r.shift[0] for r in found])
    stated = np.mean([r.deviation[0] for r in found])
    assert 0.4 * stated < spread < 2.5 * stated


def test_an_image_is_like_itself_to_its_edges() -> None:
    """Points in the outer half of the outermost pixels, as where hair fills the image."""
    camera = Camera.look_at("c", 30, 30, (0, -1, 0), (0, 0, 0), 10.0)
    x, y = np.meshgrid(np.arange(30.0), np.arange(30.0))
    image = waves(x, y)
    pixels = np.random.default_rng(0).uniform(-0.5, 29.5, (2000, 2))
    points = camera.center + camera.rays(pixels)
    view = TrackedView(camera, Template(image, np.ones((30, 30), bool)), points, pixels)
    assert likeness([view], {"c": image}, STILL) == pytest.approx(1, abs=2e-3)


def test_templates_without_mask_or_detail_raise_errors() -> None:
    with pytest.raises(ValueError, match="mask is empty"):
        Template(np.ones((8, 8)), np.zeros((8, 8), bool))
    with pytest.raises(ValueError, match="no detail"):
        Template(np.ones((8, 8)), np.ones((8, 8), bool))


def test_gradients_and_samples_of_a_wave() -> None:
    x, y = np.meshgrid(np.arange(40.0), np.arange(30.0))
    image = np.sin(0.5 * x) + np.cos(0.4 * y)
    gx, gy = gradients(image)
    inner = (slice(4, -4), slice(4, -4))
    assert np.abs(gx - 0.5 * np.cos(0.5 * x))[inner].max() < 2e-3
    assert np.abs(gy + 0.4 * np.sin(0.4 * y))[inner].max() < 2e-3
    many = np.linspace(5, 30, 40_001)
    at = sample(spline(image), many, np.full_like(many, 12.25))
    assert at.shape == many.shape
    assert np.abs(at - np.sin(0.5 * many) - np.cos(0.4 * 12.25)).max() < 2e-3


def drift(frames: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """A subject that turns by half a degree and shifts by up to 2 mm."""
    t = np.linspace(0, 1, frames)[:, None]
    turns = np.radians(t * [0.3, -0.2, 0.5])
    shifts = 1e-3 * np.concatenate([1.5 * t, -1.2 * np.sin(2 * t), 0.8 * t**2], axis=1)
    return [(Rotation.from_rotvec(r).as_matrix(), s) for r, s in zip(turns, shifts, strict=True)]


@pytest.fixture(scope="module")
def moving(
    shoot: Callable[..., Capture],
    stage_camera: Callable[..., Camera],
    stage_projector: Callable[..., Projector],
) -> Capture:
    """Three cameras around a drifting sphere, two projectors."""
    cameras = [stage_camera(f"c{k}", a, e) for k, (a, e) in enumerate([(-50, 5), (0, 40), (45, 0)])]
    projectors = [stage_projector("p0", -25.0), stage_projector("p1", 25.0)]
    return shoot(cameras=cameras, projectors=projectors, poses=drift(8), samples=2)


def pose_error(motion: Motion, poses: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Largest error over the subject's corners for each pose, metres."""
    found = zip(motion.rotations, motion.translations, poses, strict=True)
    return np.array(
        [np.linalg.norm(CORNERS @ (R - Q).T + t - s, axis=1).max() for R, t, (Q, s) in found]
    )


@pytest.mark.parametrize("method", ["direct", pytest.param("registered", marks=pytest.mark.slow)])
def test_drift_is_found_to_a_tenth_of_a_pixel(
    moving: Capture, method: Literal["direct", "registered"]
) -> None:
    stage = Stage("motion")
    motion = solve_motion(
        moving, triangulate(moving), options=MotionOptions(method=method), stage=stage
    )
    pixel = 0.9 / moving.rig.cameras[0].K[0, 0]  # metres at the subject
    error = pose_error(motion, drift(8))
    assert not motion.still
    assert motion.determined == 6
    assert error.mean() < (0.1 if method == "direct" else 0.3) * pixel
    assert stage.figures["largest_translation_mm"] == pytest.approx(2.1, abs=0.4)


def fine(points: np.ndarray) -> np.ndarray:
    """An albedo `(...)` without a period, of detail of about 8 mm."""
    rng, out = np.random.default_rng(1), np.full(points.shape[:-1], 0.6)
    for _ in range(6):
        a = rng.normal(size=3)
        a *= 2 * np.pi / 8e-3 / np.linalg.norm(a)
        out += 0.12 * np.sin(points @ a * rng.uniform(0.6, 1.4) + rng.uniform(0, 6))
    return out


@pytest.mark.slow
def test_a_subject_that_moves_by_more_than_its_detail_is_followed(
    shoot: Callable[..., Capture],
    stage_camera: Callable[..., Camera],
    stage_projector: Callable[..., Projector],
) -> None:
    """By 22 pixels in all, some 3 from one tracking frame to the next, with detail of 6."""
    angles = [(-50, 5), (0, 40), (45, 0)]
    cameras = [stage_camera(f"c{k}", a, e, size=192) for k, (a, e) in enumerate(angles)]
    t = np.linspace(0, 1, 8)[:, None]
    turns = Rotation.from_rotvec(np.radians(t * [0.3, -0.2, 1.0])).as_matrix()
    shifts = 28e-3 * np.concatenate([0.9 * t, -0.4 * np.sin(2 * t), 0.2 * t**2], axis=1)
    poses = list(zip(turns, shifts, strict=True))
    capture = shoot(
        cameras=cameras,
        projectors=[stage_projector("p", 25.0)],
        poses=poses,
        every=5,
        samples=1,
        albedo=fine,
    )
    motion = solve_motion(capture, triangulate(capture))
    pixel = 0.9 / cameras[0].K[0, 0]
    assert pose_error(motion, poses).max() < 2 * pixel


@pytest.mark.slow
def test_compensation_brings_the_points_back(moving: Capture) -> None:
    first = triangulate(moving)
    motion = solve_motion(moving, first, options=MotionOptions(between="hold"))
    second = triangulate(moving, motion=motion)

    def off(cloud: np.ndarray) -> float:
        return float(np.median(np.abs(np.linalg.norm(cloud, axis=1) - 0.1)))

    assert off(second.points) < 0.5 * off(first.points)


def test_a_still_subject_is_not_solved(sphere_capture: Capture) -> None:
    stage = Stage("motion")
    motion = solve_motion(sphere_capture, triangulate(sphere_capture), stage=stage)
    assert motion.still
    assert [item.what for item in stage.left_out] == ["motion solve"]
    R, t = motion.at([3, 30])
    assert np.array_equal(R, np.tile(np.eye(3), (2, 1, 1)))
    assert not t.any()


def test_noise_is_not_taken_for_motion(shoot: Callable[..., Capture]) -> None:
    capture = shoot(noise=0.02)
    assert solve_motion(capture, triangulate(capture)).still


def test_a_capture_without_tracking_frames_is_still(shoot: Callable[..., Capture]) -> None:
    capture = shoot(sweep=False)
    stage = Stage("motion")
    empty = triangulate(shoot(brightness=0.0))
    assert solve_motion(capture, empty, stage=stage).still
    assert stage.left_out


def test_one_camera_determines_part_of_the_motion_and_reports_it(
    shoot: Callable[..., Capture], stage_camera: Callable[..., Camera]
) -> None:
    capture = shoot(cameras=[stage_camera("only", -40)], poses=drift(4))
    stage = Stage("motion")
    motion = solve_motion(
        capture, triangulate(capture), options=MotionOptions(method="registered"), stage=stage
    )
    assert motion.determined == 3
    (warning,) = [w for w in stage.warnings if "3 of 6 directions" in w]
    missing = warning.split("zero: ")[1].split(". More")[0].split("; ")
    assert len(missing) == 3
    # which three of the plane that is missing are named is for rounding to say
    assert all("shift along" in m or "turn about" in m for m in missing)
    assert stage.figures["weakest_strength"] < 0.02
    # every pixel on its own tells more: the distance to the camera is what it tells worst
    stage = Stage("motion")
    assert solve_motion(capture, triangulate(capture), stage=stage).determined == 6
    assert stage.figures["weakest_strength"] < 0.1
    # with a turn or without one
    shift = stage.figures["weakest_direction"].split("shift along (")[1]
    axis = np.array([float(x) for x in shift[:-1].split(", ")])
    assert abs(axis @ capture.rig.cameras[0].R[2]) > 0.9
    assert np.isfinite(motion.translations).all()
    # what the camera sees is explained all the same
    device = capture.rig.cameras[0]
    Q, s = drift(4)[-1]
    near = device.center * (0.1 / np.linalg.norm(device.center))
    observed = device.project(Q @ near + s)[0]
    found = device.project(motion.rotations[-1] @ near + motion.translations[-1])[0]
    assert np.linalg.norm(observed - device.project(near)[0]) > 0.3
    assert np.linalg.norm(found - observed) < 0.25


def test_poses_between_tracking_frames() -> None:
    turn = Rotation.from_rotvec([0, 0, 0.2]).as_matrix()
    motion = Motion(
        np.array([10, 20]), np.stack([np.eye(3), turn]), np.array([[0.0, 0, 0], [0.01, 0, 0]])
    )
    R, t = motion.at([5, 15, 99])
    assert np.allclose(R[0], np.eye(3))
    assert np.allclose(R[1], Rotation.from_rotvec([0, 0, 0.1]).as_matrix())
    assert t[:, 0] == pytest.approx([0, 0.005, 0.01])
    held = replace(motion, between="hold")
    assert np.allclose(held.at([19])[0][0], np.eye(3))
    points = np.array([[0.05, 0.02, -0.01]])
    moved = points @ R[1].T + t[1]
    back, view, covariance = motion.undo([15], moved, moved, np.eye(3)[None])
    assert np.allclose(back, points)
    assert np.allclose(covariance, np.eye(3))
    assert np.allclose(view, moved @ R[1])


def test_motion_refuses_what_does_not_fit() -> None:
    with pytest.raises(ValueError, match="2 tracking frames"):
        Motion(np.array([1, 2]), np.eye(3)[None], np.zeros((1, 3)))
    with pytest.raises(ValueError, match="ascend"):
        Motion(np.array([2, 1]), np.tile(np.eye(3), (2, 1, 1)), np.zeros((2, 3)))

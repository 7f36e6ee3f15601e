"""Captures at the edge of what can be reconstructed: a result, or an error that says what is wrong.

Parallel planes and rays, one camera, saturated stripes and a sweep that lights nothing stand beside
the triangulation's own tests; here they go through the whole reconstruction.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from reconstruction import (
    Camera,
    Capture,
    CaptureError,
    Light,
    Mesh,
    Model,
    Projector,
    ReconstructOptions,
    Report,
    Stage,
    read_strands,
    reconstruct,
    write_obj,
)
from reconstruction.geometry.lights import dome_positions
from reconstruction.geometry.voxels import VoxelGrid
from reconstruction.growth.field import solve_field
from reconstruction.growth.from_roots import Tracing, grow_from_roots
from reconstruction.head.scalp import NoScalp
from reconstruction.light_planes import Motion, PointCloud, solve_motion, triangulate

RADIUS, HEAD = 0.1, 0.09
LIGHTS = [Light(f"l{i}", p, np.ones(3)) for i, p in enumerate(dome_positions(6, 1.2, 0.0))]
QUICK = ReconstructOptions(grid=5e-3, roots=60, max_length=0.1)
Shoot = Callable[..., Capture]
MakeCamera = Callable[..., Camera]


def ball(radius: float, center: Sequence[float] = (0, 0, 0)) -> Mesh:
    """A closed sphere whose upper half is marked as scalp."""
    theta, phi = np.linspace(0, np.pi, 17), np.arange(32) * 2 * np.pi / 32
    t, p = (a.ravel() for a in np.meshgrid(theta, phi, indexing="ij"))
    vertices = np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], axis=1)
    i, j = (a.ravel() for a in np.meshgrid(np.arange(16), np.arange(32), indexing="ij"))
    a, b = i * 32 + j, i * 32 + (j + 1) % 32
    faces = np.concatenate([np.stack([a, a + 32, b], 1), np.stack([b, a + 32, b + 32], 1)])
    scalp = vertices[faces][:, :, 2].mean(axis=1) > 0
    return Mesh(radius * vertices + np.asarray(center), faces, scalp)


def meridians(step: dict[str, object], camera: Camera) -> np.ndarray:
    """OLAT frames `(H, W)` of a sphere with lines of uneven brightness down its sides."""
    grid = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1)
    rays = camera.rays(grid)
    b = rays @ camera.center
    inside = b**2 - (camera.center @ camera.center - RADIUS**2)
    p = camera.center + (-b - np.sqrt(np.maximum(inside, 0)))[..., None] * rays
    light = next(x for x in LIGHTS if x.name == step["light"]).position
    shade = 0.1 + np.maximum(p @ light, 0)
    return np.where(inside > 0, (1.2 + np.cos(23 * np.arctan2(p[..., 1], p[..., 0]))) * shade, 0.0)


def black(step: dict[str, object], camera: Camera) -> np.ndarray:
    return np.zeros((camera.height, camera.width))


@pytest.fixture
def cameras(stage_camera: MakeCamera) -> list[Camera]:
    return [stage_camera(f"c{a}", a, 15.0, size=64) for a in (-60, 0, 60)]


@pytest.fixture
def stage(shoot: Shoot, cameras: list[Camera]) -> Shoot:
    """Shoots three cameras, six lights and a sweep of a hairy ball on a smaller head."""

    def make(head: Mesh | None = None, **changes: object) -> Capture:
        usual = {"cameras": cameras, "lights": LIGHTS, "extra": meridians, "samples": 1}
        capture = shoot(**(usual | changes))
        write_obj(capture.path / "head.obj", head or ball(HEAD))
        return capture

    return make


def finite(model: Path, report: Report) -> None:
    """Asserts that nothing in a model is NaN or infinite."""
    json.dumps(report.to_dict(), allow_nan=False)
    strands = read_strands(model / "strands.npz")
    assert len(strands) > 0
    assert np.isfinite(strands.points).all()
    assert np.isfinite(PointCloud.load(model / "points.npz").points).all()


def paint_masks(capture: Capture, pixels: Callable[[Camera], np.ndarray]) -> None:
    (capture.path / "masks").mkdir()
    for camera in capture.rig.cameras:
        image = pixels(camera).astype(np.uint8) * 255
        cv2.imwrite(str(capture.path / "masks" / f"{camera.name}.png"), image)


@pytest.mark.slow
def test_a_sweep_that_lights_nothing_is_done_without(stage: Shoot, tmp_path: Path) -> None:
    report = reconstruct(stage(brightness=0.0), Model(tmp_path), options=QUICK)
    finite(tmp_path, report)
    assert any("no stripe of" in w for w in report["triangulation"].warnings)


def test_a_capture_without_any_light_is_an_error(stage: Shoot, tmp_path: Path) -> None:
    capture = stage(brightness=0.0, extra=black)
    for step in capture.of_kind("all_on"):
        for camera in capture.rig.cameras:
            capture.records.pop((step.index, camera.name))
    with pytest.raises(CaptureError, match="no pixel of any camera is hair"):
        reconstruct(capture, Model(tmp_path), options=QUICK)


def test_black_single_lights_are_an_error(stage: Shoot, tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="no hair pixel has a direction"):
        reconstruct(stage(extra=black), Model(tmp_path), options=QUICK)


def test_one_camera_is_an_error(stage: Shoot, cameras: list[Camera], tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="1 cameras are left, at least 2 are needed"):
        reconstruct(stage(cameras=cameras[:1]), Model(tmp_path), options=QUICK)


@pytest.mark.slow
def test_rays_within_their_planes_leave_the_masks_alone(
    stage: Shoot,
    stage_camera: MakeCamera,
    stage_projector: Callable[..., Projector],
    tmp_path: Path,
) -> None:
    cameras = [stage_camera(f"e{e}", 0.0, e, size=64) for e in (0.0, 40.0, 75.0)]
    capture = stage(cameras=cameras, projectors=[stage_projector("proj", 0.0, 90.0)])
    report = reconstruct(capture, Model(tmp_path), options=QUICK)
    assert report["triangulation"].figures["points"] == 0
    assert report["triangulation"].figures["stripes"] > 0
    finite(tmp_path, report)


@pytest.mark.slow  # of a sweep alone, test_triangulation has it
def test_stripes_that_are_all_saturated_are_found_at_their_middle(
    stage: Shoot, tmp_path: Path
) -> None:
    report = reconstruct(stage(full_scale=0.02), Model(tmp_path), options=QUICK)
    finite(tmp_path, report)
    off = np.abs(np.linalg.norm(PointCloud.load(tmp_path / "points.npz").points, axis=1) - RADIUS)
    assert np.median(off) < 5e-4  # the middle of a flat top
    assert np.quantile(off, 0.9) < 1.5e-3


def test_empty_masks_are_an_error(stage: Shoot, tmp_path: Path) -> None:
    capture = stage()
    paint_masks(capture, lambda c: np.zeros((c.height, c.width), bool))
    with pytest.raises(CaptureError, match="no pixel of any camera is hair"):
        reconstruct(capture, Model(tmp_path), options=QUICK)


@pytest.mark.slow
def test_a_subject_away_from_its_head_is_an_error(stage: Shoot, tmp_path: Path) -> None:
    """Head and cameras in different frames: nothing of the hair is where strands can begin."""
    with pytest.raises((CaptureError, NoScalp), match=r"head|scalp"):
        reconstruct(stage(ball(HEAD, (2.0, 0, 0))), Model(tmp_path), options=QUICK)


def test_a_subject_that_no_camera_sees_is_an_error(
    stage: Shoot, cameras: list[Camera], tmp_path: Path
) -> None:
    away = [replace(c, t=np.add(c.t, [0.6, 0, 0])) for c in cameras]
    with pytest.raises(CaptureError, match="no pixel of any camera is hair"):
        reconstruct(stage(cameras=away), Model(tmp_path), options=QUICK)


def test_a_bald_head_with_a_tuft_has_strands_there_alone(stage: Shoot, tmp_path: Path) -> None:
    capture = stage()

    def top(camera: Camera) -> np.ndarray:
        x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        u, v = camera.project(np.array([0, 0, RADIUS]))[0]
        return np.hypot(x - u, y - v) < 8

    paint_masks(capture, top)
    report = reconstruct(capture, Model(tmp_path), options=QUICK)
    finite(tmp_path, report)
    tips = read_strands(tmp_path / "strands.npz").points
    assert np.median(tips[:, 2]) > 0.05
    assert report["strands"].figures["roots_without_strand"] > 0


def test_a_single_strand_is_a_result(stage: Shoot, tmp_path: Path) -> None:
    capture = stage()
    angle = np.linspace(0.2, 1.2, 200)
    strand = RADIUS * np.stack([np.sin(angle) * 0.3, -np.sin(angle), np.cos(angle)], axis=1)

    def line(camera: Camera) -> np.ndarray:
        mask = np.zeros((camera.height, camera.width), bool)
        mask[tuple(np.rint(camera.project(strand)[0][:, ::-1]).astype(int).T)] = True
        return mask

    paint_masks(capture, line)
    report = reconstruct(capture, Model(tmp_path), options=QUICK)
    finite(tmp_path, report)
    points = read_strands(tmp_path / "strands.npz").points
    off = np.linalg.norm(points[:, None] - strand, axis=-1).min(axis=1)
    assert np.median(off) < 1.5 * QUICK.grid
    assert np.quantile(off, 0.9) < 3 * QUICK.grid


def test_one_line_of_voxels_grows_one_strand() -> None:
    inside = np.zeros((3, 3, 40), bool)
    inside[1, 1] = True
    grid = VoxelGrid(np.array([-1e-3, -1e-3, 0.0]), 1e-3, inside)
    points = np.array([[0.0, 0.0, 5e-3], [0.0, 0.0, 35e-3]])
    field, _ = solve_field(grid, points, np.array([[0, 0, 1.0], [0, 0, -1.0]]), np.ones(2))
    paths = grow_from_roots(
        field, np.zeros((1, 3)), np.array([[0, 0, 1.0]]), Tracing(max_length=0.1)
    )
    assert len(paths) == 1
    assert paths[0][-1, 2] > 0.038
    assert np.abs(paths[0][:, :2]).max() < 1e-4


def test_orthogonal_tensors_leave_no_direction_and_no_strand_through() -> None:
    """Two lines that are measured as often in one voxel: their sum has no main axis."""
    grid = VoxelGrid(np.zeros(3), 1e-3, np.ones((3, 3, 12), bool))
    low, high = np.array([1e-3, 1e-3, 0.0]), np.array([1e-3, 1e-3, 11e-3])
    points = np.stack([low, low, high, high])
    directions = np.array([[1.0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 0, 1]])
    field, _ = solve_field(grid, points, directions, np.ones(4))
    assert field.degenerate.any()
    assert np.isfinite(field.directions).all()
    assert not field.directions[field.degenerate].any()
    paths = grow_from_roots(field, low[None], np.array([[0, 0, 1.0]]), Tracing(max_length=0.05))
    assert all(np.isfinite(p).all() for p in paths)


@pytest.fixture
def leaps(
    shoot: Shoot, stage_camera: MakeCamera, stage_projector: Callable[..., Projector]
) -> Capture:
    """A subject that leaps out of most pictures for a quarter of the sweep and comes back."""
    still = (np.eye(3), np.zeros(3))
    away = (np.eye(3), np.array([0.13, 0.02, -0.12]))
    cameras = [stage_camera(f"c{k}", a, e) for k, (a, e) in enumerate([(-50, 5), (0, 40), (45, 0)])]
    projectors = [stage_projector("p0", -25.0), stage_projector("p1", 25.0)]
    return shoot(
        cameras=cameras,
        projectors=projectors,
        poses=[still, still, away, still, still],
        every=16,
        samples=2,
    )


@pytest.mark.slow
def test_motion_beyond_the_search_window_is_reported_and_its_stripes_are_skipped(
    leaps: Capture,
) -> None:
    said = Stage("motion")
    motion = solve_motion(leaps, triangulate(leaps), stage=said)
    tracking = [s.index for s in leaps.of_kind("tracking")]
    assert motion.lost.tolist() == [tracking[2]]
    assert any("tracking frames" in w for w in said.warnings)
    assert np.abs(motion.translations).max() < 1e-4
    assert not motion.known([tracking[1] + 1, tracking[2], tracking[3] - 1]).any()
    assert motion.known([tracking[1] - 1, tracking[1], tracking[3], tracking[4] + 3]).all()
    held = replace(motion, between="hold")
    assert held.known([tracking[1] + 1]).all()
    assert not held.known([tracking[2] + 1]).any()
    before, after = (triangulate(leaps, motion=m) for m in (None, motion))
    off = [np.abs(np.linalg.norm(c.points, axis=1) - RADIUS) for c in (before, after)]
    assert np.percentile(off[1], 99) < 2e-3
    assert 0 < len(after) < len(before)
    assert (motion.known(after.step)).all()


def test_a_subject_that_left_gives_a_warning_and_no_points(shoot: Shoot) -> None:
    gone = (np.eye(3), np.array([3.0, 0.0, 0.0]))
    capture = shoot(poses=[(np.eye(3), np.zeros(3)), gone], every=20)
    said = Stage("motion")
    motion = solve_motion(capture, triangulate(capture), stage=said)
    assert isinstance(motion, Motion)
    assert not motion.still
    assert len(motion.lost) == 1
    assert any("1 of 2 tracking frames" in w for w in said.warnings)
    assert not triangulate(capture, motion=motion).step.size

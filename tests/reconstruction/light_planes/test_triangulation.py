"""Light-plane triangulation against a sphere that is known exactly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from reconstruction import Camera, Capture, CaptureError, Projector, Rig, Stage
from reconstruction.light_planes import (
    Motion,
    PointCloud,
    sweep_peaks,
    triangulate,
)
from reconstruction.light_planes.peaks import REACH, fit_stripes
from reconstruction.light_planes.plane_conditioning import condition, ray_plane_angles, row_pitch
from reconstruction.light_planes.triangulation import flatten, fuse, intersect, supported

Shoot = Callable[..., Capture]
RADIUS = 0.1


def off(cloud: PointCloud) -> np.ndarray:
    """Distances of the points from the sphere, metres."""
    return np.abs(np.linalg.norm(cloud.points, axis=1) - RADIUS)


def test_points_lie_on_the_sphere_within_their_stated_deviation(sphere_capture: Capture) -> None:
    stage = Stage("triangulation")
    cloud = triangulate(sphere_capture, stage=stage)
    assert len(cloud) > 1500
    assert np.median(off(cloud)) < 1e-4
    assert np.percentile(off(cloud), 90) < 3e-4
    assert np.percentile(off(cloud), 99) < 1.5e-3  # pixels that the edge only grazes
    outward = cloud.points / np.linalg.norm(cloud.points, axis=1, keepdims=True)
    normal = np.sqrt(np.einsum("ni,nij,nj->n", outward, cloud.covariance, outward))
    assert (off(cloud) < 3 * normal).mean() > 0.99
    assert stage.figures["points"] == len(cloud)
    assert set(np.unique(cloud.camera)) == {0, 1}
    assert ((cloud.weight > 0) & (cloud.weight <= 1)).all()
    assert np.allclose(np.linalg.norm(cloud.view, axis=1), 1)


def of_rays(capture: Capture) -> PointCloud:
    """The points where rays meet their planes, as measured: not yet fused, flattened or cleaned."""
    return PointCloud.merged([intersect(capture, p, None) for p in sweep_peaks(capture)])


def test_points_project_to_the_pixels_that_saw_them(sphere_capture: Capture) -> None:
    cloud = of_rays(sphere_capture)
    for name in cloud.cameras:
        mine = cloud.of_camera(name)
        pixels, _ = sphere_capture.rig.camera(name).project(mine.points)
        assert np.abs(pixels - mine.pixel).max() < 1e-6


def test_noise_is_survived_and_stated(shoot: Shoot) -> None:
    cloud = triangulate(shoot(noise=0.005))
    assert len(cloud) > 1000
    assert np.median(off(cloud)) < 3e-4
    assert (off(cloud) > 5e-3).mean() < 0.01


@pytest.mark.parametrize("centre", [-0.5, -0.31, 0.0, 0.12, 0.5])
def test_stripes_are_located_to_a_fiftieth_of_a_row(
    stage_projector: Callable[..., Projector], centre: float
) -> None:
    device = stage_projector()
    rows = np.arange(-REACH, REACH + 1)
    window = 3.0 * device.row_weight(rows, centre)[None] + 0.4
    found, deviation, correlation, light = fit_stripes(window, device, 0.0)
    assert found[0] == pytest.approx(centre, abs=0.02)
    assert light[0] == pytest.approx(3.0, rel=0.02)
    assert correlation[0] > 0.999
    assert 0 < deviation[0] < 0.2


def test_flat_light_is_no_stripe(stage_projector: Callable[..., Projector]) -> None:
    window = np.array([[1.0, 1.02, 1.01, 1.03, 1.0, 1.02, 1.01], np.zeros(7)])
    _, deviation, correlation, light = fit_stripes(window, stage_projector(), 0.0)
    assert np.isfinite(deviation).all()
    assert correlation[0] < 0.9
    assert light[1] == 0


def test_a_sweep_that_lights_nothing_gives_an_empty_cloud(shoot: Shoot) -> None:
    stage = Stage("triangulation")
    cloud = triangulate(shoot(brightness=0.0), stage=stage)
    assert len(cloud) == 0
    assert any("no stripe of" in w for w in stage.warnings)


def test_a_capture_without_a_sweep_raises_an_error(shoot: Shoot) -> None:
    with pytest.raises(CaptureError, match="no scanline frames"):
        triangulate(shoot(sweep=False))


def test_one_camera_is_enough_and_is_warned_about(
    shoot: Shoot, stage_camera: Callable[..., Camera]
) -> None:
    stage = Stage("triangulation")
    cloud = triangulate(shoot(cameras=[stage_camera("only", -40)]), stage=stage)
    assert np.median(off(cloud)) < 2e-4
    assert any("one camera" in w for w in stage.warnings)


def test_rays_inside_their_plane_give_no_points(
    shoot: Shoot,
    stage_camera: Callable[..., Camera],
    stage_projector: Callable[..., Projector],
) -> None:
    above = stage_camera("above", 0.0, 40.0)  # over the projector: its rays lie in upright planes
    cloud = triangulate(shoot(cameras=[above], projectors=[stage_projector("proj", 0.0, 90.0)]))
    assert len(cloud) == 0


def test_saturated_stripes_are_kept_with_a_larger_deviation(shoot: Shoot) -> None:
    cloud = shoot(full_scale=0.25)
    peaks = sweep_peaks(cloud)
    clipped = np.concatenate([p.saturated for p in peaks])
    deviation = np.concatenate([p.deviation for p in peaks])
    assert clipped.mean() > 0.1
    assert (deviation[clipped] >= 0.3).all()
    points = triangulate(cloud, peaks=peaks)
    assert np.median(off(points)) < 4e-4
    assert np.isfinite(points.covariance).all()


def test_a_missing_row_costs_only_its_neighbourhood(shoot: Shoot) -> None:
    stage = Stage("triangulation")
    capture = shoot(missing=[(17, "left")])
    assert np.median(off(triangulate(capture, stage=stage))) < 2e-4
    cloud = of_rays(capture)
    assert any("1 scanlines" in w and "17" in w for w in stage.warnings)
    left = cloud.of_camera("left")
    assert not ((left.row > 16.2) & (left.row < 17.8)).any()
    assert (left.row > 18.6).any()
    assert (left.row < 15.4).any()


def test_known_motion_is_undone(shoot: Shoot) -> None:
    poses = [(np.eye(3), np.array([0.0, 2e-3 * k, -1e-3 * k])) for k in range(4)]
    capture = shoot(poses=poses)
    steps = np.array([s.index for s in capture.of_kind("tracking")])
    motion = Motion(
        steps, np.stack([R for R, _ in poses]), np.stack([t for _, t in poses]), between="hold"
    )
    peaks = sweep_peaks(capture)
    assert np.median(off(triangulate(capture, peaks=peaks))) > 5e-4
    assert np.median(off(triangulate(capture, peaks=peaks, motion=motion))) < 2e-4


def test_isolated_points_are_outliers() -> None:
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.normal(0, 0.01, (500, 3)), [[0.3, 0, 0], [0, 0.3, 0]]])
    keep = supported(points, np.ones(len(points)), 8, 4.0)
    assert not keep[-2:].any()
    assert keep[:500].mean() > 0.95
    assert not supported(points[:5], np.ones(5), 8, 4.0).any()


@pytest.mark.slow
def test_points_of_a_coarse_camera_alone_are_kept_beside_a_fine_camera(
    shoot: Shoot, stage_camera: Callable[..., Camera], stage_projector: Callable[..., Projector]
) -> None:
    """A third as many pixels a side see the ball's back; alone they keep 0.88 of their points."""
    cameras = [stage_camera("fine", -40, size=192), stage_camera("coarse", 140)]
    projectors = [stage_projector("front", 0.0), stage_projector("back", 180.0)]
    kept = []
    for used in (cameras, cameras[1:]):
        cloud = triangulate(shoot(cameras=used, projectors=projectors, samples=1))
        kept.append(len(cloud.of_camera("coarse")))
    assert kept[0] == pytest.approx(kept[1], rel=0.02)


def test_points_do_not_depend_on_where_the_origin_is(sphere_capture: Capture) -> None:
    """A tracker's or the room's may lie anywhere, at a camera too."""
    capture = Capture(sphere_capture.path)
    here, rig = triangulate(capture), capture.rig
    origin = rig.cameras[0].center
    capture.rig = replace(
        rig,
        cameras=tuple(c.moved(np.eye(3), origin) for c in rig.cameras),
        projectors=tuple(p.moved(np.eye(3), origin) for p in rig.projectors),
    )
    there = triangulate(capture)
    assert len(there) == len(here)
    assert there.points == pytest.approx(here.points - origin, abs=1e-9)


def test_flattening_moves_noise_onto_the_plane_and_never_widens(sphere_capture: Capture) -> None:
    cloud = triangulate(sphere_capture)
    rng = np.random.default_rng(1)
    noisy = replace(cloud, points=cloud.points + rng.normal(0, 5e-4, cloud.points.shape))
    noisy = replace(noisy, covariance=np.tile(25e-8 * np.eye(3), (len(noisy), 1, 1)))
    flat = flatten(noisy, 6e-3, 2e-4)
    assert np.sqrt(np.mean(off(flat) ** 2)) < 0.8 * np.sqrt(np.mean(off(noisy) ** 2))
    trace = np.trace(noisy.covariance - flat.covariance, axis1=1, axis2=2)
    assert (trace >= -1e-18).all()


def test_points_of_one_pixel_that_agree_become_one(sphere_capture: Capture) -> None:
    cloud = triangulate(sphere_capture).subset(np.arange(50))
    shifted = replace(cloud, points=cloud.points - 2e-4 * cloud.view)
    both = fuse(PointCloud.merged([cloud, shifted]))
    assert len(both) == len(fuse(cloud))
    assert (both.deviation_along_view().mean()) < 0.8 * cloud.deviation_along_view().mean()
    apart = replace(cloud, points=cloud.points - 2e-2 * cloud.view)
    assert len(fuse(PointCloud.merged([cloud, apart]))) == 2 * len(fuse(cloud))


def test_points_that_a_pixel_saw_beside_each_other_of_a_moving_subject_stay_two(
    sphere_capture: Capture,
) -> None:
    """At another step the pixel saw what lies 4 mm beside: as deep, and another place."""
    cloud = fuse(triangulate(sphere_capture)).subset(np.arange(50))
    aside = np.cross(cloud.view, [0.0, 0.0, 1.0])
    aside *= 4e-3 / np.linalg.norm(aside, axis=1, keepdims=True)
    both = PointCloud.merged([cloud, replace(cloud, points=cloud.points + aside)])
    fused = fuse(both)
    assert len(fused) == 100
    assert np.allclose(np.sort(fused.points, axis=0), np.sort(both.points, axis=0), atol=1e-12)


def test_point_clouds_survive_the_disk(sphere_capture: Capture, tmp_path: Path) -> None:
    cloud = triangulate(sphere_capture)
    cloud.save(tmp_path / "points.npz")
    again = PointCloud.load(tmp_path / "points.npz")
    assert np.array_equal(again.points, cloud.points)
    assert np.array_equal(again.row, cloud.row)
    assert again.cameras == cloud.cameras
    np.savez(tmp_path / "other.npz", points=cloud.points)
    with pytest.raises(ValueError, match=r"other\.npz.*covariance"):
        PointCloud.load(tmp_path / "other.npz")


def test_point_clouds_refuse_what_is_not_finite(sphere_capture: Capture) -> None:
    cloud = triangulate(sphere_capture)
    with pytest.raises(ValueError, match="points must be finite"):
        replace(cloud, points=np.full_like(cloud.points, np.nan))


def test_angles_and_pitch_agree_with_the_planes(
    stage_camera: Callable[..., Camera], stage_projector: Callable[..., Projector]
) -> None:
    device, beam = stage_camera("c", -40), stage_projector()
    points = np.array([[0.0, 0.0, 0.0], [0.03, -0.05, 0.02]])
    row = beam.project(points)[0][:, 1]
    plane = beam.plane(row + 0.5)
    step = np.abs((points * plane[:, :3]).sum(axis=1) + plane[:, 3])
    assert row_pitch(beam, points) == pytest.approx(2 * step, rel=0.01)
    angles = np.degrees(ray_plane_angles(device, beam, points))
    assert angles[0] == pytest.approx(39.3, abs=1.5)


def test_the_demo_rig_is_well_conditioned() -> None:
    rig = Rig.load(Path(__file__).parents[3] / "stage_service" / "rigs" / "demo.toml")
    result = condition(rig)
    assert len(result.pairs) == 24
    assert result.triangulated > 0.85
    assert result.well_pairs > 0.65
    with pytest.raises(ValueError, match="no projectors"):
        condition(replace(rig, projectors=()))
    for radius in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="a sphere needs radius > 0 m"):
            condition(rig, radius=radius)
